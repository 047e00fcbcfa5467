"""Report learnt bodies: a table of each, for people and for a session, and doubts about it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import congruent_parts, tolerance_of
from mixpose.learning.adjusting import LearntBody
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import body_of
from mixpose.records import Floats
from mixpose.session.marker_files import LEARNT_COLUMNS

MARK = ",".join(LEARNT_COLUMNS)
"""The columns by which mixpose recognises tables that it wrote."""

_HARDLY = 0.1  # of the markers that other sensors meet: fewer make a sensor doubtful
_ALIKE = 0.03  # of the radius: offset up to which markers of two bodies lie alike for tracking
_TOGETHER = 0.1  # of the frames of the body that is seen less: fewer in common are mistakes
_ONE_AXIS = 0.2  # of the turn about the main axis: turn that is needed about another one
_TILTED_DEG = 5.0  # root mean square turn about another axis that is enough in any case


def _digits_of(learnt: LearntBody) -> int:
    """Return the number of decimals that show a tenth of the smallest deviation of a marker."""
    least = float(np.linalg.norm(learnt.deviations, axis=1).min())
    return int(np.clip(1 - np.floor(np.log10(max(least, 1e-12))), 0, 12))


def lines_of(learnt: LearntBody, name: str, unit: str) -> list[str]:
    """Return the lines of a table of markers for people."""
    turns = _turns(learnt)
    digits = _digits_of(learnt)
    width = max(10, digits + 7)
    head = "".join(f"{word:>{width}}" for word in ("x", "y", "z", "deviation"))
    alike = f", {learnt.count} alike at a time" if learnt.count > 1 else ""
    rows = [
        f"{name}: {len(learnt.points)} markers{alike}, adjusted in {len(set(learnt.numbers))} "
        f"frames, turned by up to {np.degrees(np.linalg.norm(turns, axis=1).max()):.0f} deg; "
        f"lengths in {unit}",
        f"{'marker':<8}{head}{'frames':>8}",
    ]
    for label, point, deviation, frames in zip(
        learnt.names, learnt.points, learnt.deviations, learnt.frames, strict=True
    ):
        size = float(np.sqrt((deviation**2).mean()))
        numbers = "".join(f"{value + 0.0:>{width}.{digits}f}" for value in (*point, size))
        rows.append(f"{label:<8}{numbers}{frames:>8}")
    return rows


def table_text(learnt: LearntBody) -> str:
    """Return a CSV table: name, coordinates, deviations and number of frames of each marker."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["name", "x", "y", "z", *LEARNT_COLUMNS])
    digits = _digits_of(learnt)
    for name, point, deviation, frames in zip(
        learnt.names, learnt.points, learnt.deviations, learnt.frames, strict=True
    ):
        numbers = [f"{value + 0.0:.{digits}f}" for value in (*point, *deviation)]
        writer.writerow([name, *numbers, int(frames)])
    return stream.getvalue()


def doubts_of(learnt: LearntBody, name: str, unit: str) -> list[str]:
    """Return notes about missing motion, symmetry, sensors that meet little, and loose markers."""
    notes = _doubts_of_motion(learnt, name)
    body = body_of(name, learnt.points)
    turns = len(body.symmetries)
    if turns > 1:
        notes.append(
            f"{name}: its markers map onto themselves in {turns - 1} other "
            f"way{'s' * (turns > 2)}: such poses cannot be told apart; move or add a marker"
        )
    for sensor, met in learnt.met.items() if len(learnt.met) > 1 else ():
        others = float(np.median([count for other, count in learnt.met.items() if other != sensor]))
        if met < _HARDLY * others:
            notes.append(
                f"{name}: {sensor!r} meets {met:.2g} of its markers in a frame, and others "
                f"{others:.2g}: does it look elsewhere, or stand elsewhere than the session says?"
            )
    if learnt.spread > 0:
        notes.append(
            f"{name}: its markers move on it by {learnt.spread:.2g} {unit}: write "
            f"sigma = {learnt.spread:.2g} into its [object]"
        )
    return notes


def _doubts_of_motion(learnt: LearntBody, name: str) -> list[str]:
    turns = np.degrees(_turns(learnt))
    most = float(np.linalg.norm(turns, axis=1).max())
    if most < RULES.turned_deg:
        return [
            f"{name}: turned by {most:.1f} deg at most; missing: turns of 30 deg or more about "
            "each axis, without which sides that no camera saw have no markers, and things that "
            "move along are not told apart"
        ]
    _, sizes, axes = np.linalg.svd(turns - np.median(turns, axis=0), full_matrices=False)
    if sizes[1] < min(_ONE_AXIS * sizes[0], _TILTED_DEG * np.sqrt(len(turns))):
        axis = ", ".join(f"{value:.2f}" for value in axes[0])
        return [
            f"{name}: turned about one axis only, ({axis}) of the world; missing: turns about "
            "another, without which what lies along this axis is not told apart"
        ]
    return []


def _turns(learnt: LearntBody) -> Floats:
    """Return rotation vectors (K, 3) in the world from the mean of all poses, or from the first."""
    turns = Rotation.from_matrix(learnt.poses[:, :3, :3])
    # poses of several bodies are not the motion of one
    middle = turns[0] if learnt.count > 1 else turns.mean()
    return np.asarray((turns * middle.inv()).as_rotvec())


def look_alikes(bodies: Sequence[LearntBody], names: Sequence[str]) -> list[str]:
    """Return notes about bodies that share three markers or more and may be confused."""
    notes = []
    models = [body_of(name, body.points) for name, body in zip(names, bodies, strict=True)]
    for k, first in enumerate(models):
        for other, second in enumerate(models[:k]):
            if parts := congruent_parts(first, second, tolerance_of(first, second, _ALIKE)):
                a = ", ".join(bodies[k].names[n] for n in parts[0].features)
                b = ", ".join(bodies[other].names[n] for n in parts[0].partners)
                hint = "where no others are seen the two cannot be told apart"
                most = 2 * len(parts[0].features) > min(len(first), len(second))
                frames, others = (set(bodies[n].numbers.tolist()) for n in (k, other))
                if most and len(frames & others) < _TOGETHER * min(len(frames), len(others)):
                    hint = "the two are hardly ever seen at a time, and may be one: leave one out"
                notes.append(f"markers {a} of {names[k]} lie like {b} of {names[other]}: {hint}")
    return notes

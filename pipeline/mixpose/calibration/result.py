"""What a calibration found, how closely it meets what was seen, and which sensor was bumped.

A new calibration from the recording says by how much every sensor is off, relative to the others,
and how sure that is.  Moving all sensors together is no matter: what counts is each sensor against
the consensus of the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body.symmetry import motions
from mixpose.calibration.adjust import MET, Adjusted
from mixpose.calibration.profile import Contradiction
from mixpose.calibration.rig import Block, Rig, centre_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import SeenFrame, Task
from mixpose.records import Floats, Indices
from mixpose.rigid import from_parts, inverse
from mixpose.sensors import CalibrationError

HELD_LENS = CalibrationError(focal=1e-3, principal_point=1.0)
"""What a lens that was calibrated by itself is easily off by."""


@dataclass(frozen=True)
class Residual:
    """Root mean square residuals of one sensor, sensor units; NaN without any."""

    before: float  # with the calibration before
    after: float
    held: float  # of every frame, with the calibration that the others tell: that of new data


@dataclass(frozen=True, eq=False)
class Sights:
    """All that one sensor saw and met, for pictures and lists."""

    y: Floats  # (n, m): detections that were met
    offset: Floats  # (n, m): detected minus predicted, after
    frame: Indices  # (n,): frame numbers
    feature: Indices  # (n,)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration with all that tells whether to trust it."""

    before: Rig
    after: Rig
    blocks: tuple[Block, ...]
    deviations: Floats  # (G,): of the free parameters; infinite where not determined
    covariance: Floats  # (G, G)
    refused: tuple[str, ...]  # directions that the data do not determine; they stay as they were
    gauge: tuple[str, ...]  # freedoms of the rig that were removed
    through: Mapping[int, tuple[int | None, int]]  # as of `Start`
    unlinked: tuple[int, ...]
    used: tuple[int, ...]  # numbers of the frames that are calibrated from
    bad: tuple[int, ...]  # and of those left out
    recorded: int  # frames of the recording with detections
    residuals: Mapping[int, Residual]
    noise: Floats  # (L,)
    inflation: float
    certainty: float  # as of `Adjusted`: near 1, or detections cannot be told apart
    # (G,): standard deviations that come of what is held of sensors of which nothing is stated:
    # biases of ranges as large as σ_ε, and lenses that are off by `HELD_LENS`
    moved_by_biases: Floats
    moved_by_lenses: Floats
    explained: Floats  # (L,): share of what each could show that the objective has met; NaN without
    sights: Mapping[int, Sights]
    poses: Mapping[int, Floats]  # (4, 4), by frame number
    contradicted: Contradiction | None = None  # what is held, and the recording says otherwise
    T_new_old: Floats | None = None  # (4, 4): to the world of `after`, where it is another one

    @property
    def are_linked(self) -> bool:
        """Whether frames that sensors share link all of them."""
        parts = list[set[int]]()  # frames of sensors that are linked
        for one in self.sights.values():
            own = set(one.frame.tolist())
            shared = [part for part in parts if part & own]
            parts = [part for part in parts if not part & own] + [own.union(*shared)]
        return len(parts) == 1

    def doubtful(self, rules: CalibrationRules) -> tuple[int, ...]:
        """Sensors that most likely stand elsewhere: what they saw is not explained."""
        return tuple(int(s) for s in np.flatnonzero(self.explained < rules.explained))


def rms(squared: Sequence[Floats]) -> float:
    """Root mean square of what is not NaN; NaN of nothing."""
    flat = np.concatenate([np.zeros(0), *squared])
    known = np.isfinite(flat)
    return float(np.sqrt(flat[known].mean())) if known.any() else float("nan")


def _could_show(frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Features (K, L) that each sensor could show."""
    most, sensors = len(task.rig.points), range(len(task.rig.sensors))
    return np.array([[min(len(f.points.get(s, ())), most) for s in sensors] for f in frames])


def met_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Share (K,) of the features that frames could show which were met, all sensors together."""
    met = sum(
        np.bincount(rows.pairs.frame, weight > MET, len(frames))
        for rows, weight in adjusted.weighted
    )
    return np.asarray(met / np.maximum(_could_show(frames, task).sum(axis=1), 1))


def explained_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Share (L,) of what each sensor could show that is met, by the objective; NaN without any."""
    could = _could_show(frames, task).sum(axis=0)
    met = np.array([weight.sum() for _, weight in adjusted.weighted])
    return np.asarray(np.where(could > 0, met / np.maximum(could, 1), np.nan))


def sights_of(adjusted: Adjusted, numbers: Sequence[int]) -> dict[int, Sights]:
    """What each sensor saw and met."""
    found, largest = {}, np.iinfo(np.intp).max
    for s, (rows, weight) in enumerate(adjusted.weighted):
        pairs, kept = rows.pairs, weight > MET
        # of longer numbers the first digits are enough for people
        named = np.array([min(n, largest) for n in numbers], dtype=np.intp)[pairs.frame[kept]]
        found[s] = Sights(pairs.y[kept], rows.residual[kept], named, pairs.feature[kept])
    return found


def residuals_by(found: Calibration, kind: Literal["frame", "feature"]) -> tuple[Indices, Floats]:
    """Numbers (n,) of frames or of features, and RMS residuals (n,), in standard deviations."""
    keys, squares = [np.zeros(0, dtype=np.intp)], [np.zeros(0)]
    for sensor, sights in found.sights.items():
        keys.append(getattr(sights, kind))
        squares.append((sights.offset**2).sum(axis=1) / found.noise[sensor] ** 2)
    numbers, which = np.unique(np.concatenate(keys), return_inverse=True)
    return numbers, np.sqrt(np.bincount(which, np.concatenate(squares)) / np.bincount(which))


@dataclass(frozen=True)
class Displacement:
    """How far one sensor is from where the old calibration has it."""

    sensor: int  # its number in the rig
    name: str
    turn_deg: float  # against the consensus of the sensors, like the shift
    shift: float
    turn_deviation_deg: float
    shift_deviation: float
    residual_before: float  # sensor units; NaN where it met nothing
    residual_after: float  # of frames that are held back where there are enough
    moved: bool


def displacements(found: Calibration, rules: CalibrationRules) -> tuple[Displacement, ...]:
    """Compare a calibration with the one it began from: all sensors that share views."""
    linked = [k for k in range(len(found.after.names)) if k not in found.unlinked]
    G = _consensus(found.before, found.after, linked)
    deviations = _deviations(found)
    told = []
    for index in linked:
        turn, shift = _apart(found.before, found.after, index, G)
        sd_turn, sd_shift = deviations[index]
        each = found.residuals[index]
        before, after = each.before, each.held if np.isfinite(each.held) else each.after
        # where it meets nothing as it was, but does now, it surely stands elsewhere
        worse = bool(np.isfinite(after) and not before <= rules.worse * max(after, 1e-12))
        far = turn > rules.moved * sd_turn or shift > rules.moved * sd_shift
        moved = worse and far
        of = index, found.after.names[index]
        told.append(Displacement(*of, turn, shift, sd_turn, sd_shift, before, after, moved))
    return tuple(told)


def before_and_after(before: Rig, after: Rig, index: int) -> tuple[Floats, Floats] | None:
    """T_sensor_world of a sensor before and after; None of a range sensor."""
    old, new = (getattr(rig.sensors[index], "T_sensor_world", None) for rig in (before, after))
    return None if old is None or new is None else (old, new)


def _consensus(before: Rig, after: Rig, linked: Sequence[int]) -> Floats:
    """The motion of the world (4, 4) after which most of some sensors stand where they stood."""
    # that of the sensor from which the others differ least: the bumped ones are outvoted
    poses = [before_and_after(before, after, k) for k in linked]
    told = [inverse(pair[0]) @ pair[1] for pair in poses if pair is not None]
    if not told:  # range sensors alone
        a, b = (np.array([centre_of(rig.sensors[k]) for k in linked]) for rig in (after, before))
        if len(a) < 3:
            return from_parts(np.eye(3), (b - a).mean(axis=0))
        return motions(a, b[None])[0]  # type: ignore[no-any-return]
    if len(told) < 3:  # of two, none is outvoted: the first is believed
        return told[0]
    worth = []
    for G in told:
        apart = [_apart(before, after, k, G) for k in linked]
        worth.append((np.median([t for t, _ in apart]), np.median([s for _, s in apart])))
    return told[int(np.lexsort(np.array(worth).T[::-1])[0])]


def _apart(before: Rig, after: Rig, index: int, G: Floats) -> tuple[float, float]:
    """Turn in degrees and shift of a sensor, the new world moved into the old one by G."""
    poses = before_and_after(before, after, index)
    if poses is None:
        place = G[:3, :3] @ centre_of(after.sensors[index]) + G[:3, 3]
        return 0.0, float(np.linalg.norm(place - centre_of(before.sensors[index])))
    old, moved = poses[0], poses[1] @ inverse(G)
    turn = Rotation.from_matrix(moved[:3, :3] @ old[:3, :3].T).magnitude()
    shift = np.linalg.norm(inverse(moved)[:3, 3] - inverse(old)[:3, 3])
    return float(np.degrees(turn)), float(shift)


def _deviations(found: Calibration) -> list[tuple[float, float]]:
    """Standard deviations of turn (degrees) and shift of each sensor; those held have the least."""
    # a sensor that is held is as uncertain against the others as they are against it
    own: dict[int, tuple[float, float]] = {}
    for block in found.blocks:
        if block.kind in ("pose", "position") and block.sensor is not None:
            part = found.deviations[block.place]
            turn = float(np.degrees(np.sqrt((part[3:] ** 2).sum())))  # none of a range sensor
            own[block.sensor] = (turn, float(np.sqrt((part[:3] ** 2).sum())))
    known = [(np.inf, np.inf), *own.values()]
    least = min(turn for turn, _ in known), min(shift for _, shift in known)
    return [own.get(index, least) for index in range(len(found.after.names))]

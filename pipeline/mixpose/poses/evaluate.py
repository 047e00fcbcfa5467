"""Compare poses with the truth, modulo the object's symmetries.

A frame may have several right answers: the lines of the truth file, times every symmetry S of the
object, ``T_truth @ S``.  A pose is compared with the answer nearest in rotation: positions of
answers are equal, or differ only with their rotations, which in a symmetry group differ by many
degrees.  Among answers with rotations that tie (within `TIE_DEG`: marks in a row, taken for their
neighbours) the one nearest in position counts.

Rotation and position errors of a frame belong to the same answer.  The error is the twist from the
answer to the pose, in the order and axes of `mixpose.rigid`; the position error is that of the
object's origin.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses import consistency
from mixpose.poses.estimates import in_unit
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.poses.truth import Swaps, renumbered, truth_ahead
from mixpose.records import Floats, Status

TIE_DEG = 0.5

FrameKey: TypeAlias = tuple[int, str]


@dataclass(frozen=True)
class FrameError:
    """The error of a body's pose in a frame; identical bodies are numbered in `object`."""

    frame: int
    object: str
    status: Status | Literal["missing"]  # "missing" if the poses have no line for it
    twist: Floats | None = None  # (6,), from the right answer to the pose, lengths and radians
    # (6,), of the best hypothesis of an ambiguous frame, its pose included
    best_twist: Floats | None = None
    nees: float | None = None  # normalised estimation error squared; None without a covariance
    dimensions: int = 0  # rank of the covariance, the expected value of `nees`
    pair: tuple[Floats, Floats] | None = field(default=None, compare=False)  # pose and right answer


@dataclass(frozen=True)
class Spread:
    """Statistics of errors over frames; `worst_frame` has the largest one."""

    rms: float
    median: float
    p95: float
    max: float
    worst_frame: int


@dataclass(frozen=True)
class Evaluation:
    """The outcome of an evaluation."""

    unit: str | None  # unit of lengths; None if neither file states it
    frames: int  # frames of the truth file: the sum of the next four counts
    # by status; "missing" frames have no line in the poses file
    ok: int
    ambiguous: int
    lost: int
    missing: int
    without_truth: int  # pose lines without truth; they count nowhere else
    ok_without_truth: int  # "ok" ones of these, wrong if the body was away
    # over frames with a pose, "ambiguous" ones included; None without such a frame
    rotation_deg: Spread | None
    translation: Spread | None
    per_axis_rms: Mapping[str, float] | None  # by `TWIST_NAMES`, lengths and degrees
    # over "ok" frames alone; None without such a frame
    ok_rotation_deg: Spread | None
    ok_translation: Spread | None
    # over ambiguous frames: the error of the best hypothesis
    best_rotation_deg: Spread | None
    best_translation: Spread | None
    nees: consistency.Consistency | None  # None if no "ok" frame has a covariance
    bodies: Mapping[str, Evaluation] = field(default_factory=dict)  # of single bodies, if several
    swaps: Swaps | None = None  # None if no bodies are identical
    offset: consistency.ConstantOffset | None = None  # that explains most errors of "ok" frames
    exchanged: bool = False  # whether the truth has covariances and the poses have none


def evaluate_files(poses: str | Path, truth: str | Path) -> Evaluation:
    """Compare a poses file with a truth file; see `evaluate`."""
    return evaluate(read_poses(poses), read_poses(truth))


def evaluate(poses: PoseFile, truth: PoseFile, *, numbered: bool = False) -> Evaluation:
    """Compare poses with the truth, in the unit of the poses, or else of the truth.

    `numbered` says that identical bodies have the numbers of the truth already. Raises
    RecordingError if the truth holds no pose, the files have no object in common, or a frame stands
    twice in the poses.
    """
    swaps = None
    if not numbered:
        poses, swaps = as_numbered(poses, truth)
    errors = errors_to_truth(poses, truth)
    labels = list(dict.fromkeys(error.object for error in errors))
    evaluation = _evaluation(poses, truth, errors)
    if len(labels) == 1:
        return replace(evaluation, swaps=swaps)
    bodies = {}
    for label in labels:
        subset = replace(poses, poses=tuple(line for line in poses.poses if line.label == label))
        selected = [error for error in errors if error.object == label]
        bodies[label] = _evaluation(subset, truth, selected)
    return replace(evaluation, bodies=bodies, swaps=swaps)


def as_numbered(poses: PoseFile, truth: PoseFile) -> tuple[PoseFile, Swaps | None]:
    """Give identical bodies of the poses the numbers that they have in the truth."""
    if all(line.instance is None for line in truth.poses):
        return poses, None
    unit = poses.unit or truth.unit
    truth = in_unit(truth_ahead(truth, poses), unit)
    symmetries = {**poses.symmetries, **truth.symmetries}
    lines, swaps = renumbered(poses.poses, truth.poses, symmetries)
    return replace(poses, poses=lines), swaps


def _evaluation(poses: PoseFile, truth: PoseFile, errors: Sequence[FrameError]) -> Evaluation:
    compared = {(error.frame, error.object) for error in errors}
    trusted = [error for error in errors if error.status == "ok"]
    counts = Counter(error.status for error in errors)
    others = [line for line in poses.poses if (line.frame, line.label) not in compared]
    return Evaluation(
        unit=poses.unit or truth.unit,
        frames=len(errors),
        ok=counts["ok"],
        ambiguous=counts["ambiguous"],
        lost=counts["lost"],
        missing=counts["missing"],
        without_truth=len(others),
        ok_without_truth=sum(line.status == "ok" for line in others),
        **_spreads([(error.frame, error.twist) for error in errors]),
        per_axis_rms=_per_axis_rms([error.twist for error in errors if error.twist is not None]),
        **_spreads([(error.frame, error.twist) for error in trusted], "ok_"),
        **_spreads([(error.frame, error.best_twist) for error in errors], "best_"),
        nees=consistency.consistency(
            [(e.nees, e.dimensions) for e in trusted if e.nees is not None]
        ),
        offset=consistency.constant_offset([e.pair for e in trusted if e.pair is not None]),
        exchanged=any(line.covariance is not None for line in truth.poses)
        and all(line.covariance is None for line in poses.poses),
    )


def errors_to_truth(poses: PoseFile, truth: PoseFile) -> tuple[FrameError, ...]:
    """Return the error of each frame and body of the truth, in its order.

    Errors are in the unit of the poses; identical bodies are matched by their numbers. Truth lines
    without a pose are skipped. Symmetries of an object are those of the truth's header, or if it
    names none, of the poses' header. Raises RecordingError as `evaluate`.
    """
    unit = poses.unit or truth.unit
    truth = in_unit(truth_ahead(truth, poses), unit)
    symmetries = {**poses.symmetries, **truth.symmetries}
    answers: dict[FrameKey, list[Floats]] = {}
    for line in truth.poses:
        if line.T_world_object is not None:
            answers.setdefault((line.frame, line.label), []).append(line.T_world_object)
    names = {line.label: line.object for line in truth.poses}
    lines = _by_frame(poses)
    _check_comparable(poses, truth, {name for _, name in answers})
    return tuple(
        _frame_error(key, lines.get(key), _right_answers(truths, symmetries.get(names[key[1]])))
        for key, truths in answers.items()
    )


def _by_frame(poses: PoseFile) -> dict[FrameKey, PoseLine]:
    lines: dict[FrameKey, PoseLine] = {}
    for line in poses.poses:
        earlier = lines.setdefault((line.frame, line.label), line)
        if earlier is not line:
            raise RecordingError(
                f"{poses.path}:{line.line}: frame {line.frame} of {line.label!r} stands in line "
                f"{earlier.line} already; poses have one line per frame (only truth has several)"
            )
    return lines


def _check_comparable(poses: PoseFile, truth: PoseFile, true_objects: set[str]) -> None:
    if not true_objects:
        raise RecordingError(f"{truth.path}: holds no pose, so there is nothing to compare with")
    objects = {line.label for line in poses.poses}
    if objects and not objects & true_objects:
        names, true = (", ".join(map(repr, sorted(group))) for group in (objects, true_objects))
        raise RecordingError(
            f"{poses.path}: holds poses of {names}, but {truth.path} of {true}; the object's name "
            "must be the same in both"
        )


def _right_answers(truths: Sequence[Floats], symmetries: Floats | None) -> Floats:
    """Return all right answers (n, 4, 4): truths times symmetries, the identity included."""
    motions = np.eye(4)[None]
    if symmetries is not None:
        motions = np.concatenate([motions, symmetries])
    return (np.stack([*truths])[:, None] @ motions).reshape(-1, 4, 4)


def _frame_error(key: FrameKey, line: PoseLine | None, answers: Floats) -> FrameError:
    frame, name = key
    if line is None:
        return FrameError(frame, name, "missing")
    if line.T_world_object is None:
        return FrameError(frame, name, line.status)
    twist, answer = _nearest_twist(answers, line.T_world_object[None])
    best_twist = None
    if line.status == "ambiguous":
        rivals = [line.T_world_object, *(rival.T_world_object for rival in line.hypotheses)]
        best_twist, _ = _nearest_twist(answers, np.stack(rivals))
    nees, dimensions = None, 0
    if line.covariance is not None:
        nees, dimensions = consistency.normalised_error_squared(twist, line.covariance)
    pair = (line.T_world_object, answer)
    return FrameError(frame, name, line.status, twist, best_twist, nees, dimensions, pair)


def _nearest_twist(answers: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Return the least error (6,) between answers (n, 4, 4) and poses (k, 4, 4), its answer too."""
    twists = rigid.twist_between(answers[:, None], poses[None]).reshape(-1, 6)
    angle_deg = np.degrees(np.linalg.norm(twists[:, 3:], axis=1))
    distance = np.linalg.norm(twists[:, :3], axis=1)
    tied = np.flatnonzero(angle_deg <= angle_deg.min() + TIE_DEG)
    nearest = int(tied[np.argmin(distance[tied])])
    return twists[nearest], answers[nearest // len(poses)]


def _spreads(twists: Sequence[tuple[int, Floats | None]], prefix: str = "") -> dict[str, Any]:
    """Return the spreads of angles (degrees) and distances, by fields of `Evaluation`."""
    frames = [frame for frame, twist in twists if twist is not None]
    errors = np.array([twist for _, twist in twists if twist is not None]).reshape(-1, 2, 3)
    distance, angle = np.linalg.norm(errors, axis=2).T
    fields = {f"{prefix}rotation_deg": np.degrees(angle), f"{prefix}translation": distance}
    return {name: _spread(frames, values) for name, values in fields.items()}


def _spread(frames: Sequence[int], values: Floats) -> Spread | None:
    if not frames:
        return None
    return Spread(
        rms=float(np.sqrt(np.mean(values**2))),
        median=float(np.median(values)),
        p95=float(np.percentile(values, 95)),
        max=float(values.max()),
        worst_frame=frames[int(np.argmax(values))],
    )


def _per_axis_rms(twists: Sequence[Floats]) -> dict[str, float] | None:
    if not twists:
        return None
    rms = np.sqrt(np.mean(np.stack(twists) ** 2, axis=0))
    rms[3:] = np.degrees(rms[3:])
    return dict(zip(rigid.TWIST_NAMES, rms.tolist()))

"""The start of a calibration: which sensors are linked, and where the body is in each frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose.calibration.linking import Seen, Votes, agreed, link_all
from mixpose.calibration.rig import Rig, State
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.searching import joint_poses
from mixpose.calibration.task import Known, Progress, SeenFrame, Task
from mixpose.records import Floats
from mixpose.rigid import inverse, transform
from mixpose.sensors import RangeSensor

_LINK_BLUR = 6.0  # σ_ε by which a linked sensor may be off before all are adjusted together
_BIAS_STEPS = 4  # of the search for a bias in a σ_ε
_FARTHEST = 0.5  # of the median distance: no bias is larger


@dataclass(frozen=True, eq=False)
class Start:
    """Where a calibration begins."""

    state: State
    frames: tuple[SeenFrame, ...]  # those with a pose
    # through which sensor each was linked (None: through known poses), and frames that agree
    through: Mapping[int, tuple[int | None, int]]
    unlinked: tuple[int, ...]  # sensors that share no view with the others


def _started(
    task: Task,
    state: State,
    kept: Sequence[int],
    through: Mapping[int, tuple[int | None, int]],
    unlinked: Sequence[int],
) -> Start:
    """A start with some of the frames, without what sensors saw that are not linked."""
    linked = [s for s in range(len(task.rig.sensors)) if s not in unlinked]
    frames = tuple(task.frames[k].only(linked) for k in kept)
    return Start(state, frames, through, tuple(unlinked))


def start_from_cameras(task: Task, known: Known, rules: CalibrationRules) -> Start:
    """Link cameras by what each sees alone, and choose a pose for every frame."""
    seen: Seen = [
        {
            s: known[f.number, s]
            for s in task.cameras
            if (f.number, s) in known and len(known[f.number, s].poses)
        }
        for f in task.frames
    ]
    if task.known is not None:
        return _from_known_poses(task, task.known, seen, rules)
    rig = task.rig
    movable = [s for s in task.cameras if "pose" in task.free.get(s, ())]
    expected = {s: rig.sensors[s].T_sensor_world for s in task.cameras}  # type: ignore[attr-defined]
    placed = {s: expected[s] for s in task.cameras if s not in movable}
    if not placed:  # all are free: one stays, and the rig is moved back in the end
        first = next((s for s in movable if any(s in each for each in seen)), movable[0])
        placed = {first: expected[first]}
    T, through = link_all(seen, placed, movable, expected, task.body.symmetries, rules)
    for sensor in through:
        rig = rig.placed(sensor, T[sensor])
    poses, worth = _likeliest_poses(rig, task, seen, sorted(T))
    kept = np.flatnonzero(worth > 0)
    unlinked = [s for s in task.cameras if s not in T]
    if len(placed) > 1:  # those that stay and see nothing with the others are no matter
        unlinked = [s for s in unlinked if s in movable]
    return _started(task, State(rig, poses[kept]), kept.tolist(), {**through}, unlinked)


def _from_known_poses(
    task: Task, known: Mapping[int, Floats], seen: Seen, rules: CalibrationRules
) -> Start:
    """Place each camera by itself, as poses are known."""
    rig, through = task.rig, dict[int, tuple[int | None, int]]()
    kept = [k for k, frame in enumerate(task.frames) if frame.number in known]
    poses = np.array([known[task.frames[k].number] for k in kept]).reshape(-1, 4, 4)
    unlinked = []
    for sensor in task.cameras:
        if "pose" not in task.free.get(sensor, ()):
            continue
        told = []
        for k, T_world_object in zip(kept, poses, strict=True):
            if sensor in seen[k]:
                own = seen[k][sensor].poses
                motions = own[:, None] @ task.body.symmetries[None] @ inverse(T_world_object)
                told.append(Votes(motions, float(np.linalg.norm(own[0][:3, 3]))))
        expected = task.rig.sensors[sensor].T_sensor_world  # type: ignore[attr-defined]
        link = agreed(told, expected, rules)
        if link is None or link.frames < 1:
            unlinked.append(sensor)
            continue
        rig = rig.placed(sensor, link.T_a_b)
        through[sensor] = (None, link.frames)
    return _started(task, State(rig, poses), kept, through, unlinked)


def starts_together(task: Task, rules: CalibrationRules, progress: Progress) -> Iterator[Start]:
    """Poses that all sensors together know, or that are known anyway."""
    if task.known is None:
        for frames, poses in joint_poses(task, rules, progress):
            yield Start(State(task.rig, poses), frames, {}, ())
        return
    frames = tuple(frame for frame in task.frames if frame.number in task.known)
    poses = np.array([task.known[frame.number] for frame in frames]).reshape(-1, 4, 4)
    yield Start(State(_biased(task, frames, poses), poses), frames, {}, ())


def _likeliest_poses(
    rig: Rig, task: Task, seen: Seen, linked: Sequence[int]
) -> tuple[Floats, Floats]:
    """The pose of each frame (K, 4, 4) that most detections of all linked sensors agree with.

    And the mean share (K,) of features in view that are met.  Where no sensor knew a pose these are
    the identity and -1.
    """
    frames = task.frames
    poses, worth = np.tile(np.eye(4), (len(frames), 1, 1)), np.full(len(frames), -1.0)
    for k, (frame, each) in enumerate(zip(frames, seen, strict=True)):
        starts = [
            inverse(rig.sensors[a].T_sensor_world) @ each[a].poses  # type: ignore[attr-defined]
            for a in linked
            if a in each
        ]
        if not starts:
            continue
        at = np.concatenate(starts)
        points = {a: frame.points[a] for a in linked if a in frame.points}
        met = np.zeros(len(at))
        for a, y in points.items():
            met += agreement(rig, a, at, y, _LINK_BLUR * task.sigmas[a])
        best = int(np.argmax(met))
        seeing = sum(len(y) > 0 for y in points.values())
        poses[k], worth[k] = at[best], met[best] / max(seeing, 1)
    return poses, worth


def agreement(rig: Rig, sensor: int, poses: Floats, points: Floats, blur: float) -> Floats:
    """Share (H,) of features in view, or of detections if fewer, that are met at poses."""
    if not len(points):
        return np.zeros(len(poses))
    y, visible = rig.seen(sensor, poses)
    squared = ((y[:, :, None] - points) ** 2).sum(axis=3)
    kernel = np.exp(-squared / (4 * blur * blur)) * visible[:, :, None]
    # a detection counts once, a feature too
    score = np.minimum(kernel.max(axis=2).sum(axis=1), kernel.max(axis=1).sum(axis=1))
    return np.asarray(score / np.maximum(np.minimum(visible.sum(axis=1), len(points)), 1))


def _biased(task: Task, frames: Sequence[SeenFrame], poses: Floats) -> Rig:
    """The rig with those range biases that are free where most ranges agree on them."""
    rig = task.rig
    for sensor, kinds in task.free.items():
        eye = rig.sensors[sensor]
        if not isinstance(eye, RangeSensor) or "range_bias" not in kinds:
            continue
        y, _ = eye.project(transform(poses, rig.points))
        shifts = [
            (frame.points[sensor].T - y[k]).ravel()
            for k, frame in enumerate(frames)
            if sensor in frame.points
        ]
        if shifts:
            farthest = _FARTHEST * float(np.median(y))
            bias = _agreed_bias(np.concatenate(shifts), farthest, float(task.sigmas[sensor]))
            rig = rig.exchanged(sensor, replace(eye, range_bias=eye.range_bias + bias))
    return rig


def _agreed_bias(shifts: Floats, farthest: float, sigma: float) -> float:
    """The shift that most ranges agree on.

    That is the objective over one number at a wide blur: Σ over all frames, features and ranges of
    a kernel at range − distance − bias.
    """
    step = sigma / _BIAS_STEPS
    places = np.arange(-farthest, farthest, step)
    counts, _ = np.histogram(shifts, bins=np.append(places, places[-1] + step) - step / 2)
    width = 4 * _BIAS_STEPS
    kernel = np.exp(-0.25 * (np.arange(-width, width + 1) / _BIAS_STEPS) ** 2)
    return float(places[np.argmax(np.convolve(counts, kernel, mode="same"))])

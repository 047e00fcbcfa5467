"""The start of a calibration: which sensors are linked, and where the body is in each frame."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mixpose.calibration.alone import Hypotheses, hypotheses
from mixpose.calibration.biases import biased
from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.jointly import joint_poses
from mixpose.calibration.linking import Link, agreed, link_all
from mixpose.calibration.rig import Rig
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.starting import start_poses
from mixpose.calibration.task import Known, Progress, Task
from mixpose.records import Floats
from mixpose.rigid import inverse

_LINK_BLUR = 6.0  # σ_ε by which a linked sensor may be off before all are adjusted together


@dataclass(frozen=True, eq=False)
class Start:
    """Where a calibration begins."""

    rig: Rig
    frames: tuple[SeenFrame, ...]  # those with a pose
    poses: Floats  # (K, 4, 4)
    # through which sensor each was linked (None: through known poses), and frames that agree
    through: Mapping[int, tuple[int | None, int]]
    unlinked: tuple[int, ...]  # sensors that share no view with the others


def searched(
    task: Task,
    rules: CalibrationRules,
    progress: Progress,
    found: dict[tuple[int, int], Hypotheses],
) -> Known:
    """Hypotheses of every camera for every frame; those in `found` are not made again."""
    wanted = [
        (frame, sensor)
        for frame in task.frames
        for sensor in task.cameras
        if sensor in frame.points
    ]
    for done, (frame, sensor) in enumerate(wanted):
        progress("searching the body in each camera alone", done, len(wanted))
        if (frame.number, sensor) not in found:
            found[frame.number, sensor] = hypotheses(
                task.rig.names[sensor],
                task.rig.sensors[sensor],
                frame.points[sensor],
                float(task.sigmas[sensor]),
                task.body,
                rules,
            )
    return found


def start_from_cameras(task: Task, known: Known, rules: CalibrationRules) -> Start:
    """Link cameras by what each sees alone, and choose a pose for every frame."""
    seen = [
        {s: known[f.number, s] for s in task.cameras if (f.number, s) in known} for f in task.frames
    ]
    if task.known is not None:
        return _from_known_poses(task, seen, rules)
    rig = task.rig
    movable = [s for s in task.cameras if "pose" in task.free.get(s, ())]
    placed = {s: rig.sensors[s].T_sensor_world for s in task.cameras if s not in movable}  # type: ignore[attr-defined]
    expected = {s: rig.sensors[s].T_sensor_world for s in task.cameras}  # type: ignore[attr-defined]
    if not placed:  # all are free: one stays, and the rig is moved back in the end
        first = next(
            (s for s in movable if any(len(e[s].poses) for e in seen if s in e)), movable[0]
        )
        placed = {first: expected[first]}
    T, through = link_all(seen, placed, movable, expected, task.body.symmetries, rules)
    for sensor in through:
        rig = rig.placed(sensor, T[sensor])
    linked = sorted(T)
    poses, worth = start_poses(rig, task.frames, seen, linked, _LINK_BLUR * task.sigmas)
    kept = np.flatnonzero(worth > 0)
    unlinked = tuple(s for s in task.cameras if s not in T)
    if len(placed) > 1:  # those that stay and see nothing with the others are no matter
        unlinked = tuple(s for s in unlinked if s in movable)
    return Start(
        rig,
        tuple(without(task.frames[k], unlinked) for k in kept),
        poses[kept],
        {s: (a, n) for s, (a, n) in through.items()},
        unlinked,
    )


def starts_together(task: Task, rules: CalibrationRules, progress: Progress) -> Iterator[Start]:
    """Poses that all sensors together know, or that are known anyway."""
    if task.known is None:
        for frames, poses in joint_poses(task, rules, progress):
            yield Start(task.rig, frames, poses, {}, ())
        return
    frames = tuple(frame for frame in task.frames if frame.number in task.known)
    poses = np.array([task.known[frame.number] for frame in frames]).reshape(-1, 4, 4)
    yield Start(biased(task, frames, poses), frames, poses, {}, ())


def without(frame: SeenFrame, sensors: Collection[int]) -> SeenFrame:
    """A frame without what some sensors saw."""
    points = {s: y for s, y in frame.points.items() if s not in sensors}
    return replace(frame, points=points)


def _from_known_poses(
    task: Task, seen: list[dict[int, Hypotheses]], rules: CalibrationRules
) -> Start:
    """Place each camera by itself, as poses are known."""
    assert task.known is not None
    rig, through = task.rig, {}
    kept = [k for k, frame in enumerate(task.frames) if frame.number in task.known]
    poses = np.array([task.known[task.frames[k].number] for k in kept]).reshape(-1, 4, 4)
    unlinked = []
    for sensor in task.cameras:
        if "pose" not in task.free.get(sensor, ()):
            continue
        link = _vote(task, seen, kept, poses, sensor, rules)
        if link is None or link.frames < 1:
            unlinked.append(sensor)
            continue
        rig = rig.placed(sensor, link.T_a_b)
        through[sensor] = (None, link.frames)
    gone = tuple(unlinked)
    frames = tuple(without(task.frames[k], gone) for k in kept)
    return Start(rig, frames, poses, through, gone)


def _vote(
    task: Task,
    seen: list[dict[int, Hypotheses]],
    kept: list[int],
    poses: Floats,
    sensor: int,
    rules: CalibrationRules,
) -> Link | None:
    votes, frame, away = [], [], []
    for k, T_world_object in zip(kept, poses, strict=True):
        each = seen[k].get(sensor)
        if each is None or not len(each.poses):
            continue
        at = each.poses[:, None] @ task.body.symmetries[None] @ inverse(T_world_object)
        flat = at.reshape(-1, 4, 4)
        votes.append(flat)
        frame.append(np.full(len(flat), k))
        away.append(np.full(len(flat), rules.shift * np.linalg.norm(each.poses[0][:3, 3])))
    if not votes:
        return None
    expected = task.rig.sensors[sensor].T_sensor_world  # type: ignore[attr-defined]
    parts = np.concatenate(votes), np.concatenate(frame), np.concatenate(away)
    return agreed(*parts, expected, rules)

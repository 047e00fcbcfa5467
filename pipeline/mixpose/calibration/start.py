"""The start of a calibration: which sensors are linked, and where the body is in each frame.

Where sensors stand to each other is told by where each of them sees the body.  Every frame that two
sensors see gives votes for their relative pose, one for each combination of their hypotheses and of
the body's symmetries; only the right ones agree over frames.  Sensors are then linked along the
pairs with most frames in agreement.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mixpose.calibration.rig import Rig, State
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.searching import Posed, posed
from mixpose.calibration.task import NOTHING, Hypotheses, Known, Progress, SeenFrame, Task
from mixpose.records import Floats, Mask
from mixpose.rigid import inverse, mean_motion, rotation_angle_deg, transform
from mixpose.sensors import RangeSensor

_LINK_BLUR = 6.0  # σ_ε by which a linked sensor may be off before all are adjusted together
_BIAS_STEPS = 4  # of the search for a bias in a σ_ε
_FARTHEST = 0.5  # of the median distance: no bias is larger

_Seen: TypeAlias = Sequence[Mapping[int, Hypotheses]]
"""By frame, then by sensor; only those that have a pose."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a calibration begins."""

    state: State
    frames: tuple[SeenFrame, ...]  # those with a pose
    # through which sensor each was linked (None: through known poses), and frames that agree
    through: Mapping[int, tuple[int | None, int]] = field(default_factory=dict)
    unlinked: tuple[int, ...] = ()  # sensors that share no view with the others
    factor: float = 1.0  # times σ_ε, with which poses were searched

    @classmethod
    def of(cls, rig: Rig, found: Sequence[Posed], factor: float = 1.0) -> Start:
        """A rig as it is believed to be, and frames whose pose is known."""
        poses = np.array([one.T_world_object for one in found]).reshape(-1, 4, 4)
        return cls(State(rig, poses), tuple(one.frame for one in found), factor=factor)

    def only(self, mask: Mask) -> Start:
        """Some of the frames (K,)."""
        frames = tuple(frame for frame, kept in zip(self.frames, mask, strict=True) if kept)
        return replace(self, frames=frames, state=self.state._replace(poses=self.state.poses[mask]))


def start_from_cameras(task: Task, known: Known, rules: CalibrationRules) -> Start:
    """Link cameras by what each sees alone, and choose a pose for every frame."""
    seen = []
    for frame in task.frames:
        each = {s: known.get((frame.number, s), NOTHING) for s in task.cameras}
        seen.append({s: one for s, one in each.items() if len(one.poses)})
    if task.known is not None:
        return _from_known_poses(task, task.known, seen, rules)
    rig = task.rig
    movable = [s for s in task.cameras if "pose" in task.free.get(s, ())]
    placed = [s for s in task.cameras if s not in movable]
    if not placed:  # all are free: one stays, and the rig is moved back in the end
        placed = [next((s for s in movable if any(s in each for each in seen)), movable[0])]
    T, through = _link_all(task, seen, placed, movable, rules)
    for sensor in through:
        rig = rig.placed(sensor, T[sensor])
    poses, worth = _likeliest_poses(rig, task, seen, sorted(T))
    kept = np.flatnonzero(worth > 0)
    unlinked = [s for s in task.cameras if s not in T]
    if len(placed) > 1:  # those that stay and see nothing with the others are no matter
        unlinked = [s for s in unlinked if s in movable]
    frames = tuple(task.frames[k].without(unlinked) for k in kept)
    return Start(State(rig, poses[kept]), frames, {**through}, tuple(unlinked))


def _from_known_poses(
    task: Task, known: Mapping[int, Floats], seen: _Seen, rules: CalibrationRules
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
                motions = own[:, None] @ task.rig.body.symmetries[None] @ inverse(T_world_object)
                told.append(_Votes(motions, float(np.linalg.norm(own[0][:3, 3]))))
        link = _agreed(told, _pose_of(task, sensor), rules)
        if link is None or link.frames < 1:
            unlinked.append(sensor)
            continue
        rig = rig.placed(sensor, link.T_a_b)
        through[sensor] = (None, link.frames)
    frames = tuple(task.frames[k].without(unlinked) for k in kept)
    return Start(State(rig, poses), frames, through, tuple(unlinked))


def starts_together(task: Task, rules: CalibrationRules, progress: Progress) -> Iterator[Start]:
    """Poses that all sensors together know, blur after blur, or that are known anyway."""
    if task.known is not None:
        known = task.known
        start = Start.of(
            task.rig, [Posed(f, known[f.number]) for f in task.frames if f.number in known]
        )
        rig = _biased(task, start.frames, start.state.poses)
        yield replace(start, state=start.state._replace(rig=rig))
        return
    for factor in rules.widened:
        found = posed(task, factor, progress)
        sure = [one for one in found if one.is_sure]
        # where hardly any pose is believed, the likeliest are a start, and deviations will tell
        few = len(sure) < rules.believed * len(task.frames)
        yield Start.of(
            task.rig, sorted(found, key=lambda one: one.frame.number) if few else sure, factor
        )


def _likeliest_poses(
    rig: Rig, task: Task, seen: _Seen, linked: Sequence[int]
) -> tuple[Floats, Floats]:
    """The pose of each frame (K, 4, 4) that most detections of all linked sensors agree with."""
    # and the mean share (K,) of features in view that are met; -1 where no sensor knew a pose
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
    """The shift that most ranges agree on: the objective over one number, at a wide blur."""
    # Σ over all frames, features and ranges of a kernel at range − distance − bias
    step = sigma / _BIAS_STEPS
    places = np.arange(-farthest, farthest, step)
    counts, _ = np.histogram(shifts, bins=np.append(places, places[-1] + step) - step / 2)
    width = 4 * _BIAS_STEPS
    kernel = np.exp(-0.25 * (np.arange(-width, width + 1) / _BIAS_STEPS) ** 2)
    return float(places[np.argmax(np.convolve(counts, kernel, mode="same"))])


class _Votes(NamedTuple):
    """What one frame says of a relative pose."""

    motions: Floats  # (..., 4, 4)
    distance: float  # to the body: translations err by a share of it


class _Link(NamedTuple):
    """The relative pose of two sensors."""

    T_a_b: Floats  # (4, 4)
    frames: int  # that agree on it


def _agreed(told: Sequence[_Votes], T_expected: Floats, rules: CalibrationRules) -> _Link | None:
    """The motion that votes of most frames agree on; the expected one decides between equals."""
    if not told:
        return None
    parts = [each.motions.reshape(-1, 4, 4) for each in told]
    votes, counts = np.concatenate(parts), [len(part) for part in parts]
    frame = np.repeat(np.arange(len(told)), counts)
    away = np.repeat([rules.shift * each.distance for each in told], counts)
    near = np.argsort(rotation_angle_deg(T_expected, votes), kind="stable")
    half = rules.seeds // 2
    spread = np.linspace(0, len(votes) - 1, min(half, len(votes))).astype(int)
    best, best_score = 0, (-1.0, 0.0)
    for seed in np.unique(np.concatenate([near[:half], spread])):
        inside, distance = _inside(votes[seed], votes, away, rules)
        # the mean distance decides between middles of one cluster
        score = (float(len(np.unique(frame[inside]))), -float(distance[inside].mean()))
        if score > best_score:
            best, best_score = int(seed), score
    T = votes[best]
    for _ in range(3):
        inside, distance = _inside(T, votes, away, rules)
        order = np.flatnonzero(inside)
        order = order[np.argsort(distance[order], kind="stable")]
        chosen = order[np.unique(frame[order], return_index=True)[1]]  # the nearest of each frame
        T = mean_motion(votes[chosen])
        T[:3, 3] = np.median(votes[chosen, :3, 3], axis=0)
    return _Link(T, len(chosen))


def _inside(T: Floats, votes: Floats, away: Floats, rules: CalibrationRules) -> tuple[Mask, Floats]:
    turn = rotation_angle_deg(T, votes) / rules.turn_deg
    shift = np.linalg.norm(votes[:, :3, 3] - T[:3, 3], axis=1) / away
    distance = np.maximum(turn, shift)
    return distance < 1, distance


def _pair_link(task: Task, seen: _Seen, a: int, b: int, rules: CalibrationRules) -> _Link | None:
    """Where sensor b stands to sensor a, by frames in which both know a pose."""
    told = []
    for each in seen:
        if a in each and b in each:
            T_a, T_b = each[a].poses, each[b].poses
            S = task.rig.body.symmetries[None, None]
            motions = T_a[:, None, None] @ S @ inverse(T_b)[None, :, None]
            reach = float(np.linalg.norm(T_a[0][:3, 3]) + np.linalg.norm(T_b[0][:3, 3])) / 2
            told.append(_Votes(motions, reach))
    link = _agreed(told, _pose_of(task, a) @ inverse(_pose_of(task, b)), rules)
    # fewer frames must agree only where hardly any are there
    least = max(min(rules.least_link, len(told)), 1)
    return link if link is not None and link.frames >= least else None


def _link_all(
    task: Task, seen: _Seen, placed: Collection[int], wanted: Sequence[int], rules: CalibrationRules
) -> tuple[dict[int, Floats], dict[int, tuple[int, int]]]:
    """Place sensors one after the other, along the strongest links to those that stay."""
    # T_sensor_world of all that are linked; through which sensor, and in how many frames they agree
    T, through = {s: _pose_of(task, s) for s in placed}, {}
    left = [one for one in wanted if one not in T]
    links: dict[tuple[int, int], _Link | None] = {}
    while left:
        best: tuple[_Link, int, int] | None = None
        for b in left:
            for a in sorted(T):
                if (b, a) not in links:
                    links[b, a] = _pair_link(task, seen, b, a, rules)
                link = links[b, a]
                if link is not None and (best is None or link.frames > best[0].frames):
                    best = (link, b, a)
        if best is None:
            break
        link, b, a = best
        T[b] = link.T_a_b @ T[a]
        through[b] = (a, link.frames)
        left.remove(b)
    return T, through


def _pose_of(task: Task, sensor: int) -> Floats:
    """T_sensor_world as the session has it."""
    return task.rig.sensors[sensor].T_sensor_world  # type: ignore[attr-defined, no-any-return]

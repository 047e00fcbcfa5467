"""The start of a calibration: which sensors are linked, and where the body is in each frame.

Relative poses of sensors follow from where each of them sees the body.  Every frame that two
sensors share votes for their relative pose, once for each combination of their hypotheses and of
the body's symmetries; only the right votes agree over frames.  Sensors are then linked along the
pairs with most frames in agreement.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mixpose.calibration.rig import Rig, State
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.searching import PosedFrame, posed_frames
from mixpose.calibration.task import NOTHING, Hypotheses, Known, Progress, SeenFrame, Task
from mixpose.records import Floats, Mask
from mixpose.rigid import inverse, mean_motion, rotation_angle_deg, transform
from mixpose.sensors import RangeSensor

_LINK_BLUR = 6.0  # σ_ε by which a linked sensor may be off before all are adjusted together
_BIAS_STEPS = 4  # per σ_ε, in the search for a bias
_FARTHEST = 0.5  # of the median distance: no bias is larger

_Frames: TypeAlias = Sequence[Mapping[int, Hypotheses]]
"""Hypotheses by frame, then by sensor; only sensors that have some."""


@dataclass(frozen=True, eq=False)
class Start:
    """The rig and poses at which a calibration begins."""

    state: State
    frames: tuple[SeenFrame, ...]  # those with a pose
    # sensor through which each was linked (None: through known poses), and frames that agree
    through: Mapping[int, tuple[int | None, int]] = field(default_factory=dict)
    unlinked: tuple[int, ...] = ()  # sensors that share no view with the others
    factor: float = 1.0  # of the blur σ_ε with which poses were searched

    @classmethod
    def of(cls, rig: Rig, posed: Sequence[PosedFrame], factor: float = 1.0) -> Start:
        """Return the start from a rig and frames with a pose."""
        poses = np.array([p.T_world_object for p in posed]).reshape(-1, 4, 4)
        return cls(State(rig, poses), tuple(p.frame for p in posed), factor=factor)

    def only(self, mask: Mask) -> Start:
        """Return the start with the frames of a mask (K,)."""
        frames = tuple(frame for frame, kept in zip(self.frames, mask, strict=True) if kept)
        return replace(self, frames=frames, state=self.state._replace(poses=self.state.poses[mask]))


def start_from_cameras(task: Task, known: Known, rules: CalibrationRules) -> Start:
    """Link cameras by hypotheses of each alone, and choose a pose for every frame."""
    by_frame = []
    for frame in task.frames:
        by_sensor = {s: known.get((frame.number, s), NOTHING) for s in task.cameras}
        by_frame.append({s: h for s, h in by_sensor.items() if len(h.poses)})
    if task.known is not None:
        return _from_known_poses(task, task.known, by_frame, rules)
    rig = task.rig
    movable = [s for s in task.cameras if "pose" in task.free.get(s, ())]
    placed = [s for s in task.cameras if s not in movable]
    if not placed:  # all are free: one is held, and the rig is moved back in the end
        placed = [next((s for s in movable if any(s in seen for seen in by_frame)), movable[0])]
    T, through = _link_all(task, by_frame, placed, movable, rules)
    for sensor in through:
        rig = rig.placed(sensor, T[sensor])
    poses, share = _likeliest_poses(rig, task, by_frame, sorted(T))
    kept = np.flatnonzero(share > 0)
    unlinked = [s for s in task.cameras if s not in T]
    if len(placed) > 1:  # held sensors need no view that others share
        unlinked = [s for s in unlinked if s in movable]
    frames = tuple(task.frames[k].without(unlinked) for k in kept)
    return Start(State(rig, poses[kept]), frames, {**through}, tuple(unlinked))


def _from_known_poses(
    task: Task, known: Mapping[int, Floats], by_frame: _Frames, rules: CalibrationRules
) -> Start:
    """Place each camera by itself, by known poses."""
    rig, through = task.rig, dict[int, tuple[int | None, int]]()
    kept = [k for k, frame in enumerate(task.frames) if frame.number in known]
    poses = np.array([known[task.frames[k].number] for k in kept]).reshape(-1, 4, 4)
    unlinked = []
    for sensor in task.cameras:
        if "pose" not in task.free.get(sensor, ()):
            continue
        votes = []
        for k, T_world_object in zip(kept, poses, strict=True):
            if sensor in by_frame[k]:
                seen = by_frame[k][sensor].poses
                motions = seen[:, None] @ task.rig.body.symmetries[None] @ inverse(T_world_object)
                votes.append(_Votes(motions, float(np.linalg.norm(seen[0][:3, 3]))))
        link = _agreed(votes, _pose_of(task, sensor), rules)
        if link is None or link.frames < 1:
            unlinked.append(sensor)
            continue
        rig = rig.placed(sensor, link.T_a_b)
        through[sensor] = (None, link.frames)
    frames = tuple(task.frames[k].without(unlinked) for k in kept)
    return Start(State(rig, poses), frames, through, tuple(unlinked))


def starts_together(task: Task, rules: CalibrationRules, progress: Progress) -> Iterator[Start]:
    """Yield starts by poses of all sensors together, blur after blur, or by known poses."""
    if task.known is not None:
        known = task.known
        start = Start.of(
            task.rig, [PosedFrame(f, known[f.number]) for f in task.frames if f.number in known]
        )
        rig = _with_biases(task, start.frames, start.state.poses)
        yield replace(start, state=start.state._replace(rig=rig))
        return
    for factor in rules.widened:
        frames = posed_frames(task, factor, progress)
        sure = [frame for frame in frames if frame.is_sure]
        # if hardly any pose is sure, all are a start, and deviations show whether it was right
        few = len(sure) < rules.believed * len(task.frames)
        yield Start.of(
            task.rig, sorted(frames, key=lambda f: f.frame.number) if few else sure, factor
        )


def _likeliest_poses(
    rig: Rig, task: Task, by_frame: _Frames, linked: Sequence[int]
) -> tuple[Floats, Floats]:
    """Return the pose of each frame (K, 4, 4) on which linked sensors agree best."""
    # and the mean `agreement` (K,) of the sensors; -1 without a hypothesis
    frames = task.frames
    chosen, shares = np.tile(np.eye(4), (len(frames), 1, 1)), np.full(len(frames), -1.0)
    for k, (frame, by_sensor) in enumerate(zip(frames, by_frame, strict=True)):
        starts = [
            inverse(rig.sensors[a].T_sensor_world) @ by_sensor[a].poses  # type: ignore[attr-defined]
            for a in linked
            if a in by_sensor
        ]
        if not starts:
            continue
        poses = np.concatenate(starts)
        points = {a: frame.points[a] for a in linked if a in frame.points}
        met_shares = np.zeros(len(poses))
        for a, y in points.items():
            met_shares += agreement(rig, a, poses, y, _LINK_BLUR * task.sigmas[a])
        best = int(np.argmax(met_shares))
        seeing = sum(len(y) > 0 for y in points.values())
        chosen[k], shares[k] = poses[best], met_shares[best] / max(seeing, 1)
    return chosen, shares


def agreement(rig: Rig, sensor: int, poses: Floats, points: Floats, blur: float) -> Floats:
    """Return the share (H,) of features in view, or of detections if fewer, met at poses."""
    if not len(points):
        return np.zeros(len(poses))
    y, visible = rig.project(sensor, poses)
    squared = ((y[:, :, None] - points) ** 2).sum(axis=3)
    kernel = np.exp(-squared / (4 * blur * blur)) * visible[:, :, None]
    # each detection and each feature counts at most once
    score = np.minimum(kernel.max(axis=2).sum(axis=1), kernel.max(axis=1).sum(axis=1))
    return np.asarray(score / np.maximum(np.minimum(visible.sum(axis=1), len(points)), 1))


def _with_biases(task: Task, frames: Sequence[SeenFrame], poses: Floats) -> Rig:
    """Return the rig with free range biases set to those on which most ranges agree."""
    rig = task.rig
    for sensor, kinds in task.free.items():
        geometry = rig.sensors[sensor]
        if not isinstance(geometry, RangeSensor) or "range_bias" not in kinds:
            continue
        y, _ = geometry.project(transform(poses, rig.points))
        shifts = [
            (frame.points[sensor].T - y[k]).ravel()
            for k, frame in enumerate(frames)
            if sensor in frame.points
        ]
        if shifts:
            farthest = _FARTHEST * float(np.median(y))
            bias = _agreed_bias(np.concatenate(shifts), farthest, float(task.sigmas[sensor]))
            rig = rig.exchanged(sensor, replace(geometry, range_bias=geometry.range_bias + bias))
    return rig


def _agreed_bias(shifts: Floats, farthest: float, sigma: float) -> float:
    """Return the shift on which most ranges agree, by the objective at a wide blur."""
    # Σ over all frames, features and ranges of a kernel at range − distance − bias
    step = sigma / _BIAS_STEPS
    places = np.arange(-farthest, farthest, step)
    counts, _ = np.histogram(shifts, bins=np.append(places, places[-1] + step) - step / 2)
    width = 4 * _BIAS_STEPS
    kernel = np.exp(-0.25 * (np.arange(-width, width + 1) / _BIAS_STEPS) ** 2)
    return float(places[np.argmax(np.convolve(counts, kernel, mode="same"))])


class _Votes(NamedTuple):
    """Votes of a frame for a relative pose."""

    motions: Floats  # (..., 4, 4)
    distance: float  # to the body; translations err by a share of it


class _Link(NamedTuple):
    """The relative pose of two sensors, or of a sensor and the world."""

    T_a_b: Floats  # (4, 4)
    frames: int  # that agree on it


def _agreed(frames: Sequence[_Votes], T_expected: Floats, rules: CalibrationRules) -> _Link | None:
    """Return the motion on which votes of most frames agree; seeds near the expected are tried."""
    if not frames:
        return None
    parts = [f.motions.reshape(-1, 4, 4) for f in frames]
    votes, counts = np.concatenate(parts), [len(part) for part in parts]
    frame = np.repeat(np.arange(len(frames)), counts)
    limits = np.repeat([rules.shift * f.distance for f in frames], counts)
    near = np.argsort(rotation_angle_deg(T_expected, votes), kind="stable")
    half = rules.seeds // 2
    spread = np.linspace(0, len(votes) - 1, min(half, len(votes))).astype(int)
    best, best_score = 0, (-1.0, 0.0)
    for seed in np.unique(np.concatenate([near[:half], spread])):
        is_near, distance = _near(votes[seed], votes, limits, rules)
        # the mean distance decides between seeds of one cluster
        score = (float(len(np.unique(frame[is_near]))), -float(distance[is_near].mean()))
        if score > best_score:
            best, best_score = int(seed), score
    T = votes[best]
    for _ in range(3):
        is_near, distance = _near(T, votes, limits, rules)
        order = np.flatnonzero(is_near)
        order = order[np.argsort(distance[order], kind="stable")]
        chosen = order[np.unique(frame[order], return_index=True)[1]]  # the nearest of each frame
        T = mean_motion(votes[chosen])
        T[:3, 3] = np.median(votes[chosen, :3, 3], axis=0)
    return _Link(T, len(chosen))


def _near(T: Floats, votes: Floats, limits: Floats, rules: CalibrationRules) -> tuple[Mask, Floats]:
    """Test which votes are within the tolerances of T; return their distances in these, too."""
    turn = rotation_angle_deg(T, votes) / rules.turn_deg
    shift = np.linalg.norm(votes[:, :3, 3] - T[:3, 3], axis=1) / limits
    distance = np.maximum(turn, shift)
    return distance < 1, distance


def _pair_link(task: Task, poses: _Frames, a: int, b: int, rules: CalibrationRules) -> _Link | None:
    """Return the pose of sensor b relative to a by frames in which both have hypotheses."""
    votes = []
    for by_sensor in poses:
        if a in by_sensor and b in by_sensor:
            T_a, T_b = by_sensor[a].poses, by_sensor[b].poses
            S = task.rig.body.symmetries[None, None]
            motions = T_a[:, None, None] @ S @ inverse(T_b)[None, :, None]
            distance = float(np.linalg.norm(T_a[0][:3, 3]) + np.linalg.norm(T_b[0][:3, 3])) / 2
            votes.append(_Votes(motions, distance))
    link = _agreed(votes, _pose_of(task, a) @ inverse(_pose_of(task, b)), rules)
    # fewer frames need to agree only if hardly any are shared
    least = max(min(rules.least_link, len(votes)), 1)
    return link if link is not None and link.frames >= least else None


def _link_all(
    task: Task, by_frame: _Frames, placed: list[int], movable: list[int], rules: CalibrationRules
) -> tuple[dict[int, Floats], dict[int, tuple[int, int]]]:
    """Place sensors one after the other, along the strongest links to sensors placed before."""
    # T_sensor_world of placed sensors; the sensor each was linked through, and frames that agree
    T, through = {s: _pose_of(task, s) for s in placed}, {}
    unlinked = [s for s in movable if s not in T]
    links: dict[tuple[int, int], _Link | None] = {}
    while unlinked:
        best: tuple[_Link, int, int] | None = None
        for b in unlinked:
            for a in sorted(T):
                if (b, a) not in links:
                    links[b, a] = _pair_link(task, by_frame, b, a, rules)
                link = links[b, a]
                if link is not None and (best is None or link.frames > best[0].frames):
                    best = (link, b, a)
        if best is None:
            break
        link, b, a = best
        T[b] = link.T_a_b @ T[a]
        through[b] = (a, link.frames)
        unlinked.remove(b)
    return T, through


def _pose_of(task: Task, sensor: int) -> Floats:
    """Return T_sensor_world of the session."""
    return task.rig.sensors[sensor].T_sensor_world  # type: ignore[attr-defined, no-any-return]

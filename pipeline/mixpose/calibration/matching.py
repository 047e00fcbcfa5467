"""Which detection may be which feature, softly: the weights of the matched objective.

The gradient of ⟨g, h⟩ at a blur σ is that of weighted least squares over all pairs of a detection d
and a predicted feature p, with the weights exp(−|d − p|²/4σ²); ⟨h, h⟩ keeps features from taking
the same detection, for which a pair's weight is shared out where several compete.

Features are where the body is at the moment a sensor looks.  Between the frames' common times the
pose is the cubic through the frames next to it, in the twists that lead there from the nearest one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from mixpose.calibration.rig import Rig, State
from mixpose.calibration.task import SeenFrame
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb, twist_between
from mixpose.sensors.moving import read_times, row_span

_NODES = 4  # frames that motion is interpolated through
_TOGETHER = 32  # frames that pairs are looked for at a time
_STEP = 1e-3  # of a readout: motion in an image is told over it


@dataclass(frozen=True, eq=False)
class Clock:
    """When sensors look, and the frames that a frame's motion is interpolated through."""

    nodes: Indices  # (K, 4): the frame itself first; where there are fewer, itself again
    away: Floats  # (K, 4): seconds from the frame to each; NaN where there are fewer
    late: Floats  # (L, K): seconds from a frame's common time to a sensor's; 0 where not known
    since: Floats  # (L, K): seconds from the middle of the recording

    def tau(self, rig: Rig, sensor: int, frame: Indices, y: Floats | None = None) -> Floats:
        """Seconds from the common time of frames (n,) to when a sensor took them, or read y."""
        late = self.late[sensor, frame] + rig.delays[sensor]
        late = late + rig.drifts[sensor] * self.since[sensor, frame]
        return late if y is None else read_times(rig.sensors[sensor], y, late, rig.readouts[sensor])


def clock_of(frames: Sequence[SeenFrame], sensors: int, gap: float) -> Clock:
    """When sensors say that they look; frames are neighbours within `gap` median intervals each."""
    late, since = np.zeros((sensors, len(frames))), np.zeros((sensors, len(frames)))
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    middle = (min(times) + max(times)) / 2 if times else 0.0
    for k, frame in enumerate(frames):
        for sensor, time in frame.times.items():
            if frame.time_s is not None:
                late[sensor, k] = time - frame.time_s
                since[sensor, k] = time - middle
    return Clock(*_neighbours([frame.time_s for frame in frames], gap), late, since)


def _neighbours(times: Sequence[float | None], gap: float) -> tuple[Indices, Floats]:
    """Nodes and how far they are away, as of `Clock`."""
    count = len(times)
    index = np.repeat(np.arange(count)[:, None], _NODES, axis=1)
    away = np.full((count, _NODES), np.nan)
    away[:, 0] = 0.0
    if count < 2 or any(t is None for t in times):
        return index, away
    stamps = np.array(times, dtype=np.float64)
    order = np.argsort(stamps, kind="stable")
    reach = gap * float(np.median(np.diff(stamps[order])))
    for place, k in enumerate(order):
        near = [p for p in range(place - 3, place + 4) if 0 <= p < count and p != place]
        near = [p for p in near if 0 < abs(stamps[order[p]] - stamps[k]) <= reach * 1.5]
        near.sort(key=lambda p: abs(stamps[order[p]] - stamps[k]))
        # of one time only one: no motion goes through two poses at once
        firsts: dict[float, int] = {}
        for p in near:
            firsts.setdefault(stamps[order[p]], p)
        for node, p in enumerate(islice(firsts.values(), _NODES - 1), start=1):
            index[k, node], away[k, node] = order[p], stamps[order[p]] - stamps[k]
    return index, away


class Interpolated(NamedTuple):
    """Poses at offsets in time."""

    twist: Floats  # (n, 6): from the frame's pose to that at the offset
    rate: Floats  # (n, 6): twist per second there
    shares: Floats  # (n, 4): by how much it follows each of the neighbours
    known: Mask  # (n,): whether there are frames to interpolate between


def interpolate(clock: Clock, poses: Floats, frame: Indices, tau: Floats) -> Interpolated:
    """Twists from frames (n,), of poses (K, 4, 4), to the poses tau (n,) seconds later."""
    away = clock.away[frame]
    shares, slopes = _lagrange(away, tau)
    # once for each frame: there are as many of one as it has pairs
    twists = twist_between(np.repeat(poses[:, None], _NODES, axis=1), poses[clock.nodes])[frame]
    return Interpolated(
        np.einsum("nj,njk->nk", shares, twists),
        np.einsum("nj,njk->nk", slopes, twists),
        shares,
        np.isfinite(away[:, 1]),
    )


def _lagrange(away: Floats, tau: Floats) -> tuple[Floats, Floats]:
    """Lagrange polynomials through nodes (n, 4) at tau (n,), and their slopes; 0 where NaN."""
    there = np.isfinite(away)
    x = np.where(there, away, 0.0)
    shares, slopes = np.zeros(away.shape), np.zeros(away.shape)
    for j in range(_NODES):
        value, slope = np.ones(len(tau)), np.zeros(len(tau))
        for i in range(_NODES):
            if i == j:
                continue
            both = there[:, i] & there[:, j]
            width = np.where(both, x[:, j] - x[:, i], 1.0)
            factor = np.where(both, (tau - x[:, i]) / width, 1.0)
            slope = slope * factor + np.where(both, value / width, 0.0)
            value = value * factor
        shares[:, j], slopes[:, j] = value * there[:, j], slope * there[:, j]
    return shares, slopes


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of detections and features of one sensor, over all frames."""

    frame: Indices  # (n,)
    feature: Indices  # (n,)
    detection: Indices  # (n,)
    y: Floats  # (n, m): detected place
    share: Floats  # (n,): 1 where nothing competes
    nearest: Mask  # (n,): whether each of the two is the nearest that the other has


def match(
    state: State,
    frames: Sequence[SeenFrame],
    clock: Clock,
    sensor: int,
    blur: float,
    faintest: float,
) -> Pairs:
    """Pair detections and features of a sensor at a blur, in sensor units.

    Pairs whose weight is less than `faintest` are left out.
    """
    reach = 2 * blur * np.sqrt(-np.log(faintest))
    y, visible = _seen(state, clock, sensor)
    none = np.zeros(0, dtype=np.intp)
    parts = [(none, none, none, y[none, 0], np.zeros(0), none > 0)]
    for first in range(0, len(frames), _TOGETHER):
        some = slice(first, first + _TOGETHER)
        points = _filled_up(frames[some], sensor, y.shape[2])
        k, i, j, share, nearest = _near(y[some], visible[some], points, blur, reach)
        parts.append((first + k, i, j, points[k, j], share, nearest))
    return Pairs(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _seen(state: State, clock: Clock, sensor: int) -> tuple[Floats, Mask]:
    """Where features (K, N, m) are for a sensor when it looks, and whether they are in view."""
    poses, frame = state.poses, np.arange(len(state.poses))
    tau = clock.tau(state.rig, sensor, frame)
    if tau.any():
        poses = perturb(poses, interpolate(clock, poses, frame, tau).twist)
    y, visible = state.rig.seen(sensor, poses)
    readout = state.rig.readouts[sensor]
    if readout:  # to the first order: a row is read when the body is a little further
        step = _STEP * readout
        ahead = perturb(state.poses, interpolate(clock, state.poses, frame, tau + step).twist)
        y_ahead, there = state.rig.seen(sensor, ahead)
        rate, eye = (y_ahead - y) / step, state.rig.sensors[sensor]
        after = read_times(eye, y, 0.0, readout) / (1 - rate[..., 1] * readout / row_span(eye))
        y, visible = y + rate * after[..., None], visible & there
    return y, visible


def _filled_up(frames: Sequence[SeenFrame], sensor: int, dimension: int) -> Floats:
    """Detections (K, D, m) of frames, infinitely far where there are fewer."""
    seen = [frame.points.get(sensor, np.zeros((0, dimension))) for frame in frames]
    points = np.full((len(frames), max(1, *map(len, seen)), dimension), np.inf)
    for k, each in enumerate(seen):
        points[k, : len(each)] = each
    return points


def _near(
    y: Floats, visible: Mask, points: Floats, blur: float, reach: float
) -> tuple[Indices, Indices, Indices, Floats, Mask]:
    """Pairs within reach: frames, features, detections, shares, and whether they are nearest."""
    away = np.where(visible[..., None], y, np.nan)[:, :, None] - points[:, None]
    squared = (away * away).sum(axis=3)
    squared[np.isnan(squared)] = np.inf
    kernel = np.exp(-squared / (4 * blur * blur)) * (squared < reach * reach)
    rivals = np.maximum(kernel.sum(axis=2)[:, :, None], kernel.sum(axis=1)[:, None])
    least = squared == squared.min(axis=2)[:, :, None]
    least &= squared == squared.min(axis=1)[:, None]
    k, i, j = there = np.nonzero(kernel)
    return k, i, j, kernel[there] / rivals[there], least[there]


def nearest_distance(
    state: State, frames: Sequence[SeenFrame], clock: Clock, sensor: int
) -> Floats:
    """Distance of every predicted feature in view to the nearest detection, all frames together."""
    found = [np.zeros(0)]
    for frame, y, visible in zip(frames, *_seen(state, clock, sensor), strict=True):
        points = frame.points.get(sensor)
        if points is not None and len(points):
            found.append(cKDTree(points).query(y[visible])[0])
    return np.concatenate(found)


def feature_spacing(state: State, sensor: int) -> float:
    """Median distance of a feature to its neighbour in a sensor."""
    found = [
        cKDTree(y[visible]).query(y[visible], k=2)[0][:, 1]
        for y, visible in zip(*state.rig.seen(sensor, state.poses), strict=True)
        if visible.sum() > 1
    ]
    return float(np.median(np.concatenate(found))) if found else np.inf

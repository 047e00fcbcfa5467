"""Soft pairs of detections and features: the weights of the matched objective.

The gradient of ⟨g, h⟩ at a blur σ is that of weighted least squares over all pairs of a detection d
and a predicted feature p, with the weights exp(−|d − p|²/4σ²); ⟨h, h⟩ keeps features from taking
the same detection, for which a pair's weight is shared out among competing pairs.

Features are projected at the moment a sensor looks.  Between the frames' common times the pose is
the cubic through neighbouring frames, in the twists that lead to them from the nearest frame.
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
_TOGETHER = 32  # frames that are matched at a time
_STEP = 1e-3  # of a readout, to differentiate motion in an image


@dataclass(frozen=True, eq=False)
class Clock:
    """Times of sensors, and the frames through which a frame's motion is interpolated."""

    nodes: Indices  # (K, 4): the frame itself first, and again in place of missing neighbours
    offsets: Floats  # (K, 4): seconds from the frame to each node; NaN for missing neighbours
    lags: Floats  # (L, K): seconds from a frame's common time to a sensor's; 0 if not known
    elapsed: Floats  # (L, K): seconds from the middle of the recording

    def tau(self, rig: Rig, sensor: int, frame: Indices, y: Floats | None = None) -> Floats:
        """Return seconds from the common time of frames (n,) to when a sensor took them, or y."""
        lag = self.lags[sensor, frame] + rig.delays[sensor]
        lag = lag + rig.drifts[sensor] * self.elapsed[sensor, frame]
        return lag if y is None else read_times(rig.sensors[sensor], y, lag, rig.readouts[sensor])


def clock_of(frames: Sequence[SeenFrame], sensors: int, gap: float) -> Clock:
    """Collect times of sensors; neighbouring frames are within 1.5 `gap` median intervals."""
    lags, elapsed = np.zeros((sensors, len(frames))), np.zeros((sensors, len(frames)))
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    middle = (min(times) + max(times)) / 2 if times else 0.0
    for k, frame in enumerate(frames):
        for sensor, time in frame.times.items():
            if frame.time_s is not None:
                lags[sensor, k] = time - frame.time_s
                elapsed[sensor, k] = time - middle
    return Clock(*_neighbours([frame.time_s for frame in frames], gap), lags, elapsed)


def _neighbours(times: Sequence[float | None], gap: float) -> tuple[Indices, Floats]:
    """Return nodes and their time offsets, as of `Clock`."""
    count = len(times)
    index = np.repeat(np.arange(count)[:, None], _NODES, axis=1)
    offsets = np.full((count, _NODES), np.nan)
    offsets[:, 0] = 0.0
    if count < 2 or any(t is None for t in times):
        return index, offsets
    stamps = np.array(times, dtype=np.float64)
    order = np.argsort(stamps, kind="stable")
    reach = gap * float(np.median(np.diff(stamps[order])))
    for rank, k in enumerate(order):
        near = [p for p in range(rank - 3, rank + 4) if 0 <= p < count and p != rank]
        near = [p for p in near if 0 < abs(stamps[order[p]] - stamps[k]) <= reach * 1.5]
        near.sort(key=lambda p: abs(stamps[order[p]] - stamps[k]))
        # only one frame of each time: no motion goes through two poses at once
        firsts: dict[float, int] = {}
        for p in near:
            firsts.setdefault(stamps[order[p]], p)
        for node, p in enumerate(islice(firsts.values(), _NODES - 1), start=1):
            index[k, node], offsets[k, node] = order[p], stamps[order[p]] - stamps[k]
    return index, offsets


class Interpolated(NamedTuple):
    """Poses interpolated at offsets in time from frames."""

    twist: Floats  # (n, 6): from the frame's pose to that at the offset
    rate: Floats  # (n, 6): twist per second at the offset
    shares: Floats  # (n, 4): weights of the nodes
    known: Mask  # (n,): whether the frame has neighbours to interpolate between


def interpolate(clock: Clock, poses: Floats, frame: Indices, tau: Floats) -> Interpolated:
    """Return twists from frames (n,), of poses (K, 4, 4), to the poses tau (n,) seconds later."""
    offsets = clock.offsets[frame]
    shares, slopes = _lagrange(offsets, tau)
    # computed once for each frame, as a frame has many pairs
    twists = twist_between(np.repeat(poses[:, None], _NODES, axis=1), poses[clock.nodes])[frame]
    return Interpolated(
        np.einsum("nj,njk->nk", shares, twists),
        np.einsum("nj,njk->nk", slopes, twists),
        shares,
        np.isfinite(offsets[:, 1]),
    )


def _lagrange(offsets: Floats, tau: Floats) -> tuple[Floats, Floats]:
    """Return Lagrange polynomials through nodes (n, 4) at tau (n,), and slopes; 0 of NaN nodes."""
    is_known = np.isfinite(offsets)
    x = np.where(is_known, offsets, 0.0)
    shares, slopes = np.zeros(offsets.shape), np.zeros(offsets.shape)
    for j in range(_NODES):
        value, slope = np.ones(len(tau)), np.zeros(len(tau))
        for i in range(_NODES):
            if i == j:
                continue
            both = is_known[:, i] & is_known[:, j]
            width = np.where(both, x[:, j] - x[:, i], 1.0)
            factor = np.where(both, (tau - x[:, i]) / width, 1.0)
            slope = slope * factor + np.where(both, value / width, 0.0)
            value = value * factor
        shares[:, j], slopes[:, j] = value * is_known[:, j], slope * is_known[:, j]
    return shares, slopes


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of detections and features of a sensor, over all frames."""

    frame: Indices  # (n,)
    feature: Indices  # (n,)
    detection: Indices  # (n,)
    y: Floats  # (n, m): place of the detection
    share: Floats  # (n,): 1 if no other pair competes
    nearest: Mask  # (n,): whether both are the nearest to each other


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
    y, visible = _projected(state, clock, sensor)
    none = np.zeros(0, dtype=np.intp)
    parts = [(none, none, none, y[none, 0], np.zeros(0), none > 0)]
    for first in range(0, len(frames), _TOGETHER):
        batch = slice(first, first + _TOGETHER)
        seen = [frame.points.get(sensor, np.zeros((0, y.shape[2]))) for frame in frames[batch]]
        # padded by detections infinitely far away
        points = np.full((len(seen), max(1, *map(len, seen)), y.shape[2]), np.inf)
        for number, detections in enumerate(seen):
            points[number, : len(detections)] = detections
        k, i, j, share, nearest = _pairs_within(y[batch], visible[batch], points, blur, reach)
        parts.append((first + k, i, j, points[k, j], share, nearest))
    return Pairs(*(np.concatenate(batches) for batches in zip(*parts, strict=True)))


def _projected(state: State, clock: Clock, sensor: int) -> tuple[Floats, Mask]:
    """Project features (K, N, m) at the moments of a sensor, and test which are in view."""
    poses, frame = state.poses, np.arange(len(state.poses))
    tau = clock.tau(state.rig, sensor, frame)
    if tau.any():
        poses = perturb(poses, interpolate(clock, poses, frame, tau).twist)
    y, visible = state.rig.project(sensor, poses)
    readout = state.rig.readouts[sensor]
    if readout:  # to first order, as each row is read at a later pose of the body
        step = _STEP * readout
        ahead = perturb(state.poses, interpolate(clock, state.poses, frame, tau + step).twist)
        y_ahead, visible_ahead = state.rig.project(sensor, ahead)
        rate, eye = (y_ahead - y) / step, state.rig.sensors[sensor]
        after = read_times(eye, y, 0.0, readout) / (1 - rate[..., 1] * readout / row_span(eye))
        y, visible = y + rate * after[..., None], visible & visible_ahead
    return y, visible


def _pairs_within(
    y: Floats, visible: Mask, points: Floats, blur: float, reach: float
) -> tuple[Indices, Indices, Indices, Floats, Mask]:
    """Return pairs within reach: frames, features, detections, shares, and which are nearest."""
    offsets = np.where(visible[..., None], y, np.nan)[:, :, None] - points[:, None]
    squared = (offsets * offsets).sum(axis=3)
    squared[np.isnan(squared)] = np.inf
    kernel = np.exp(-squared / (4 * blur * blur)) * (squared < reach * reach)
    rivals = np.maximum(kernel.sum(axis=2)[:, :, None], kernel.sum(axis=1)[:, None])
    least = squared == squared.min(axis=2)[:, :, None]
    least &= squared == squared.min(axis=1)[:, None]
    k, i, j = pairs = np.nonzero(kernel)
    return k, i, j, kernel[pairs] / rivals[pairs], least[pairs]


def nearest_distance(
    state: State, frames: Sequence[SeenFrame], clock: Clock, sensor: int
) -> Floats:
    """Return distances of predicted features in view to their nearest detections, of all frames."""
    distances = [np.zeros(0)]
    for frame, y, visible in zip(frames, *_projected(state, clock, sensor), strict=True):
        points = frame.points.get(sensor)
        if points is not None and len(points):
            distances.append(cKDTree(points).query(y[visible])[0])
    return np.concatenate(distances)


def feature_spacing(state: State, sensor: int) -> float:
    """Return the median distance of a feature to its neighbour in a sensor."""
    distances = [
        cKDTree(y[visible]).query(y[visible], k=2)[0][:, 1]
        for y, visible in zip(*state.rig.project(sensor, state.poses), strict=True)
        if visible.sum() > 1
    ]
    return float(np.median(np.concatenate(distances))) if distances else np.inf

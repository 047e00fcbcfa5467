"""Where the body is at the moment a sensor looks, between the frames' common times.

Between frames the pose is the cubic through the frames next to it, in the twists that lead there
from the nearest frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mixpose.calibration.rig import Rig
from mixpose.calibration.task import SeenFrame
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import twist_between

_NODES = 4


@dataclass(frozen=True, eq=False)
class Clock:
    """When sensors look, and the frames that a frame's motion is interpolated through."""

    nodes: Indices  # (K, 4): the frame itself first; where there are fewer, itself again
    away: Floats  # (K, 4): seconds from the frame to each; NaN where there are fewer
    late: Floats  # (L, K): seconds from a frame's common time to a sensor's; 0 where not known
    since: Floats  # (L, K): seconds from the middle of the recording

    def tau(self, rig: Rig, sensor: int, frame: Indices) -> Floats:
        """Seconds from the common time of frames (n,) to when a sensor took them."""
        late = self.late[sensor, frame] + rig.delays[sensor]
        return np.asarray(late + rig.drifts[sensor] * self.since[sensor, frame])


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
        for node, p in enumerate(near[: _NODES - 1], start=1):
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
    nodes, away = clock.nodes[frame], clock.away[frame]
    shares, slopes = _lagrange(away, tau)
    T_here = np.repeat(poses[frame][:, None], _NODES, axis=1)
    twists = twist_between(T_here, poses[nodes])
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

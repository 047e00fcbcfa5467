"""Where the body is at the moment a sensor looks, between the frames' common times.

Between frames the pose is the cubic through the frames next to it, in the twists that lead there
from the nearest frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats
from mixpose.rigid import twist_between

_NODES = 4


class Neighbours(NamedTuple):
    """Frames that a frame's motion is interpolated through."""

    nodes: NDArray[np.intp]  # (K, 4): the frame itself first; where there are fewer, itself again
    away: Floats  # (K, 4): seconds from the frame to each; NaN where there are fewer


def neighbours(times: Sequence[float | None], gap: float) -> Neighbours:
    """Find the frames nearest in time, within `gap` median intervals each."""
    count = len(times)
    index = np.repeat(np.arange(count)[:, None], _NODES, axis=1)
    away = np.full((count, _NODES), np.nan)
    away[:, 0] = 0.0
    if count < 2 or any(t is None for t in times):
        return Neighbours(index, away)
    stamps = np.array(times, dtype=np.float64)
    order = np.argsort(stamps, kind="stable")
    reach = gap * float(np.median(np.diff(stamps[order])))
    for place, k in enumerate(order):
        near = [p for p in range(place - 3, place + 4) if 0 <= p < count and p != place]
        near = [p for p in near if 0 < abs(stamps[order[p]] - stamps[k]) <= reach * 1.5]
        near.sort(key=lambda p: abs(stamps[order[p]] - stamps[k]))
        for node, p in enumerate(near[: _NODES - 1], start=1):
            index[k, node], away[k, node] = order[p], stamps[order[p]] - stamps[k]
    return Neighbours(index, away)


class Interpolated(NamedTuple):
    """Poses at offsets in time."""

    twist: Floats  # (n, 6): from the frame's pose to that at the offset
    rate: Floats  # (n, 6): twist per second there
    shares: Floats  # (n, 4): by how much it follows each of the neighbours
    known: NDArray[np.bool_]  # (n,): whether there are frames to interpolate between


def interpolate(
    near: Neighbours, poses: Floats, frame: NDArray[np.intp], tau: Floats
) -> Interpolated:
    """Twists from frames (n,) to the poses tau (n,) seconds later.

    Parameters
    ----------
    poses : (K, 4, 4) array
    frame : (n,) int
    tau : (n,) array
    """
    nodes, away = near.nodes[frame], near.away[frame]
    shares, slopes = _lagrange(away, tau)
    T_here = np.repeat(poses[frame][:, None], _NODES, axis=1)
    twists = twist_between(T_here, poses[nodes])
    known = np.isfinite(away[:, 1])
    return Interpolated(
        np.einsum("nj,njk->nk", shares, twists),
        np.einsum("nj,njk->nk", slopes, twists),
        shares,
        known,
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

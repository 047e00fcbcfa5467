"""Points in space of each frame, where lines of sight of two cameras or more meet, or of clouds.

And what of them does not move: points that are at one place of the world in most frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erf

from mixpose.calibration import SeenFrame
from mixpose.learning.rules import RULES
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import inverse, transform
from mixpose.search import triangulate
from mixpose.sensors import CloudSensor, Rays, Sensor

_STEPS = 3  # of Gauss-Newton, from the middle between two rays
_SHARES = np.logspace(-2.5, 0.3, 60)  # deviations that are tried, by the gate


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in space that one frame shows, some of which are ghosts: rays that meet by chance."""

    points: Floats  # (P, 3): in the world
    reach: Floats  # (P,): standard deviation of a point along the axis in which it is known worst
    detections: Indices  # (P, L): of each sensor the detection that it is seen as, or -1
    rows: Indices  # (P,): which points these are of all that the frame shows
    seen: SeenFrame  # all detections of the frame

    def __len__(self) -> int:
        return len(self.points)

    def loosened(self, times: float) -> Cloud:
        """The cloud with points that are known less well."""
        return replace(self, reach=times * self.reach)

    def without(self, detections: Indices) -> Cloud:
        """What is left where detections (n, L) are taken by something else."""
        left = np.ones(len(self), dtype=np.bool_)
        for sensor in range(self.detections.shape[1]):
            taken = detections[:, sensor]
            left &= ~np.isin(self.detections[:, sensor], taken[taken >= 0])
        points, reach, rows = self.points[left], self.reach[left], self.rows[left]
        return Cloud(points, reach, self.detections[left], rows, self.seen)


def clouds_of(
    frames: Sequence[SeenFrame], sensors: Sequence[Sensor], sigmas: Floats
) -> tuple[list[Cloud], float]:
    """Triangulate every frame; and the deviation of detections, as a share of their σ_ε.

    That of cameras, by how closely lines of sight meet; points of clouds do not tell theirs.
    """
    told = [_seen(frame, sensors) for frame in frames]
    wide = RULES.widest * sigmas
    some = np.linspace(0, len(told) - 1, min(len(told), RULES.probes)).astype(int)
    gaps = [_meetings(told[k][1], wide)[2] for k in np.unique(some)]
    noise = max(RULES.widest * _deviation(np.concatenate([np.zeros(0), *gaps])), RULES.quietest)
    shares = np.where(are_points(sensors), RULES.of_clouds, noise)
    gates = np.minimum(RULES.gate * shares, RULES.widest) * sigmas
    return [_cloud(*each, sensors, shares * sigmas, gates) for each in told], noise


def are_points(sensors: Sequence[Sensor]) -> Mask:
    """Which sensors (L,) measure points in space: one of them shows what cameras show by two."""
    return np.array([isinstance(sensor, CloudSensor) for sensor in sensors])


def _seen(frame: SeenFrame, sensors: Sequence[Sensor]) -> tuple[SeenFrame, dict[int, Rays]]:
    """The frame with those detections that are points or have a line of sight, and these lines."""
    rays, seen = dict[int, Rays](), dict[int, Floats]()
    for sensor, points in sorted(frame.points.items()):
        found = sensors[sensor].rays(points) if len(points) else None
        if found is not None and len(found):
            rays[sensor], seen[sensor] = found, found.pixels
        elif len(points) and isinstance(sensors[sensor], CloudSensor):
            seen[sensor] = points
    return SeenFrame(frame.number, frame.time_s, seen, frame.times), rays


def _meetings(rays: dict[int, Rays], gates: Floats) -> tuple[Floats, Indices, Floats]:
    """Points (P, 3) where two rays meet, their detections (P, L), and how closely they meet."""
    lines = [rays[k] for k in sorted(rays)]
    index = np.array(sorted(rays), dtype=np.intp)
    if len(lines) < 2:
        return np.zeros((0, 3)), np.zeros((0, len(gates)), dtype=np.intp), np.zeros(0)
    met = triangulate(lines, gates[index].tolist())
    detections = np.full((len(met.points), len(gates)), -1, dtype=np.intp)
    rows = np.arange(len(met.points))
    for side in (0, 1):
        detections[rows, index[met.sensors[:, side]]] = met.rays[:, side]
    return met.points, detections, met.gap


def _deviation(gaps: Floats) -> float:
    """Standard deviation of gaps (n,), shares of a gate, between rays that belong together."""
    # those of rays that meet by chance are spread evenly from 0 to 1, the others are half a
    # Gaussian, cut at 1; the likeliest mixture is taken
    if not len(gaps):
        return 0.0
    best, found = -np.inf, 1.0
    for deviation in _SHARES:
        density = np.exp(-(gaps**2) / (2 * deviation**2)) / (deviation * np.sqrt(np.pi / 2))
        density /= erf(1 / (np.sqrt(2) * deviation))
        share = 0.5
        for _ in range(20):
            share = float(np.mean(share * density / (share * density + 1 - share)))
        likely = float(np.log(share * density + 1 - share).sum())
        if likely > best:
            best, found = likely, float(deviation)
    return found


def _cloud(
    frame: SeenFrame, rays: dict[int, Rays], sensors: Sequence[Sensor], noise: Floats, gates: Floats
) -> Cloud:
    points, detections, gaps = _meetings(rays, gates)
    measured, own = _measured(frame, sensors)
    points, detections = np.concatenate([points, measured]), np.concatenate([detections, own])
    gaps = np.append(gaps, np.zeros(len(own)))
    if len(frame.points) > (1 if len(own) else 2) and len(points):  # others may confirm them
        detections = _supported(points, detections, gaps, frame, sensors, gates)
        kept = (detections >= 0).any(axis=1)
        points, detections = points[kept], detections[kept]
    points, reach = _refined(points, detections, frame, sensors, noise)
    fine = np.isfinite(np.column_stack([points, reach])).all(axis=1)
    rows = np.arange(np.count_nonzero(fine))
    return Cloud(points[fine], reach[fine], detections[fine], rows, frame)


def _measured(frame: SeenFrame, sensors: Sequence[Sensor]) -> tuple[Floats, Indices]:
    """The points (P, 3) of clouds, in the world, and their detections (P, L)."""
    points, detections = [np.zeros((0, 3))], [np.zeros((0, len(sensors)), dtype=np.intp)]
    for k, seen in frame.points.items():
        if isinstance(sensor := sensors[k], CloudSensor):
            points.append(transform(inverse(sensor.T_sensor_world), seen))
            detections.append(np.full((len(seen), len(sensors)), -1))
            detections[-1][:, k] = np.arange(len(seen))
    return np.concatenate(points), np.concatenate(detections)


def _supported(
    points: Floats,
    detections: Indices,
    gaps: Floats,
    frame: SeenFrame,
    sensors: Sequence[Sensor],
    gates: Floats,
) -> Indices:
    """Detections (P, L) of all sensors that see the points; -1 throughout for those left out."""
    # of points that share detections the one that most sensors confirm stays; what only two cameras
    # see is a ghost where one of its detections belongs to a point of three or more, or of a cloud
    off, each = gaps.copy(), np.where(are_points(sensors), 3, 1)
    for sensor, pixels in frame.points.items():
        y, visible = sensors[sensor].project(points)
        away, nearest = cKDTree(pixels).query(y)
        found = visible & (away < gates[sensor]) & (detections[:, sensor] < 0)
        detections[found, sensor] = nearest[found]
        off[found] += away[found] / gates[sensor]
    views: Indices = np.asarray((detections >= 0) @ each, dtype=np.intp)
    taken = [set[int]() for _ in sensors]
    kept = np.zeros(len(points), dtype=np.bool_)
    for k in np.lexsort((off / views, -views)):
        own = [(s, d) for s, d in enumerate(detections[k].tolist()) if d >= 0]
        shared = sum(int(each[s]) for s, d in own if d in taken[s])
        if shared > max(views[k] - 3, 0):
            continue
        kept[k] = True
        if views[k] > 2:
            for s, d in own:
                taken[s].add(d)
    return np.where(kept[:, None], detections, -1)


def _refined(
    points: Floats, detections: Indices, frame: SeenFrame, sensors: Sequence[Sensor], noise: Floats
) -> tuple[Floats, Floats]:
    """Points (P, 3) by least squares over all their detections, and their deviations (P,)."""
    information = np.zeros((len(points), 3, 3))
    for _ in range(_STEPS if len(points) else 0):
        information, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for sensor, pixels in frame.points.items():
            seen = detections[:, sensor] >= 0
            if not seen.any():
                continue
            y, J, visible = sensors[sensor].linearise(points[seen])
            J = J * visible[:, None, None] / noise[sensor]
            r = np.where(visible[:, None], pixels[detections[seen, sensor]] - y, 0.0)
            information[seen] += np.swapaxes(J, 1, 2) @ J
            pull[seen] += np.einsum("nmk,nm->nk", J, r / noise[sensor])
        finite: Mask = np.asarray(np.isfinite(information).all(axis=(1, 2)))
        values = np.linalg.eigvalsh(np.where(finite[:, None, None], information, 0.0))
        fixed = values[:, 0] > 1e-12 * values[:, 2]  # known in all directions
        information[~fixed] = np.nan
        step = np.full(points.shape, np.nan)
        step[fixed] = np.linalg.solve(information[fixed], pull[fixed][..., None])[..., 0]
        points = points + step
    known = np.isfinite(points).all(axis=1)
    reach = np.full(len(points), np.nan)
    reach[known] = 1 / np.sqrt(np.linalg.eigvalsh(information[known])[:, 0])
    return points, reach


def gathered_places(
    points: Floats, reach: Floats, frame: Indices, least: float
) -> list[tuple[Floats, Indices]]:
    """Places (3,) at which points (n, 3) of many frames are, and which; most frames first.

    Points may be off by their reach (n,), standard deviations times the gate.  Frames (n,) that
    tell the same have one number, and at least so many must show a place.  Of each frame at most
    one point is there, the nearest; those within three gates are left out of later places.
    """
    found: list[tuple[Floats, Indices]] = []
    if len(points) < least:
        return found
    typical = float(np.median(reach))
    allowed = np.maximum(reach, typical)
    tree = cKDTree(points)
    near = tree.query_ball_point(points, 2 * typical)
    counts = np.array([len(np.unique(frame[each])) for each in near])
    left = np.ones(len(points), dtype=np.bool_)
    for k in np.argsort(-counts, kind="stable"):
        if counts[k] < least:
            break
        if not left[k]:
            continue
        place = points[k]
        for _ in range(3):
            there = np.array(tree.query_ball_point(place, 3 * typical), dtype=np.intp)
            away = np.linalg.norm(points[there] - place, axis=1)
            inside = there[away <= allowed[there]]
            if not len(inside):
                break
            weight = 1 / reach[inside] ** 2
            place = weight @ points[inside] / weight.sum()
        away = np.linalg.norm(points[there] - place, axis=1)
        left[there] = left[k] = False
        near_by = len(np.unique(frame[there]))
        chosen = there[np.argsort(away, kind="stable")]
        chosen = chosen[np.sort(away) <= allowed[chosen]]
        _, first = np.unique(frame[chosen], return_index=True)
        chosen = chosen[np.sort(first)]
        if len(chosen) >= max(least, RULES.gathered * near_by):
            found.append((place, chosen))
    return found


def without_still(clouds: Sequence[Cloud]) -> tuple[list[Cloud], list[Floats]]:
    """Clouds without what stands still, and where that is.

    A body that rests in most of the frames is lost from these alone.
    """
    points = np.concatenate([cloud.points for cloud in clouds])
    reach = RULES.gate * np.concatenate([cloud.reach for cloud in clouds])
    frame = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    filled = sum(len(cloud) > 0 for cloud in clouds)
    least = max(RULES.still_share * filled, RULES.least_frames)
    still = gathered_places(points, reach, frame, least)
    detections = np.concatenate([cloud.detections for cloud in clouds])
    taken = np.concatenate([np.zeros(0, dtype=np.intp), *(chosen for _, chosen in still)])
    left = [cloud.without(detections[taken[frame[taken] == k]]) for k, cloud in enumerate(clouds)]
    return left, [place for place, _ in still]


def without_places(
    frame: SeenFrame, places: Sequence[Floats], sensors: Sequence[Sensor], gates: Floats
) -> SeenFrame:
    """A frame without the detections that are within gates (L,) of where places (3,) are seen."""
    points = dict(frame.points)
    for sensor, pixels in frame.points.items():
        y, visible = sensors[sensor].project(np.array(places))
        away = np.linalg.norm(pixels[:, None] - y[visible], axis=2)
        points[sensor] = pixels[(away > gates[sensor]).all(axis=1)]
    return replace(frame, points=points)

"""Points in space of each frame: where lines of sight of cameras meet, or of clouds.

Points that are at one place of the world in most frames do not move and are removed.
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
_SHARES = np.logspace(-2.5, 0.3, 60)  # candidate deviations, as shares of the gate


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in space of one frame, some of which are ghosts: rays that meet by chance."""

    points: Floats  # (P, 3): in the world
    sigma: Floats  # (P,): standard deviation of a point along its least known axis
    detections: Indices  # (P, L): of each sensor the detection that shows the point, or -1
    rows: Indices  # (P,): of each point its index among all points of the frame
    frame: SeenFrame  # all detections

    def __len__(self) -> int:
        return len(self.points)

    def loosened(self, times: float) -> Cloud:
        """Return the cloud with larger standard deviations."""
        return replace(self, sigma=times * self.sigma)

    def without(self, detections: Indices) -> Cloud:
        """Return the cloud without the points that use some detections (n, L)."""
        remaining = np.ones(len(self), dtype=np.bool_)
        for sensor in range(self.detections.shape[1]):
            taken = detections[:, sensor]
            remaining &= ~np.isin(self.detections[:, sensor], taken[taken >= 0])
        points, sigma, rows = self.points[remaining], self.sigma[remaining], self.rows[remaining]
        return Cloud(points, sigma, self.detections[remaining], rows, self.frame)


def clouds_of(
    frames: Sequence[SeenFrame], sensors: Sequence[Sensor], sigmas: Floats
) -> tuple[list[Cloud], float]:
    """Triangulate every frame; also return the deviation of detections, as a share of their σ_ε.

    It is estimated from the gaps between lines of sight; points of clouds do not show theirs.
    """
    prepared = [_with_rays(frame, sensors) for frame in frames]
    wide = RULES.widest * sigmas
    probes = np.linspace(0, len(prepared) - 1, min(len(prepared), RULES.probes)).astype(int)
    gaps = [_meetings(prepared[k][1], wide)[2] for k in np.unique(probes)]
    noise = max(RULES.widest * _deviation(np.concatenate([np.zeros(0), *gaps])), RULES.quietest)
    shares = np.where(are_points(sensors), RULES.of_clouds, noise)
    gates = np.minimum(RULES.gate * shares, RULES.widest) * sigmas
    return [_cloud(f, rays, sensors, shares * sigmas, gates) for f, rays in prepared], noise


def are_points(sensors: Sequence[Sensor]) -> Mask:
    """Test which sensors (L,) measure points in space; one of them shows as much as two cameras."""
    return np.array([isinstance(sensor, CloudSensor) for sensor in sensors])


def _with_rays(frame: SeenFrame, sensors: Sequence[Sensor]) -> tuple[SeenFrame, dict[int, Rays]]:
    """Return the frame with detections that have lines of sight or are points, and these lines."""
    rays, detections = dict[int, Rays](), dict[int, Floats]()
    for sensor, points in sorted(frame.points.items()):
        lines = sensors[sensor].rays(points) if len(points) else None
        if lines is not None and len(lines):
            rays[sensor], detections[sensor] = lines, lines.pixels
        elif len(points) and isinstance(sensors[sensor], CloudSensor):
            detections[sensor] = points
    return SeenFrame(frame.number, frame.time_s, detections, frame.times), rays


def _meetings(rays: dict[int, Rays], gates: Floats) -> tuple[Floats, Indices, Floats]:
    """Return where two rays meet: points (P, 3), their detections (P, L), and gaps (P,)."""
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
    """Estimate the deviation of gaps (n,), shares of a gate, between rays that belong together."""
    # gaps of rays that meet by chance are uniform from 0 to 1, the others are half a Gaussian, cut
    # at 1; the mixture with the largest likelihood is taken
    if not len(gaps):
        return 0.0
    largest, likeliest = -np.inf, 1.0
    for deviation in _SHARES:
        density = np.exp(-(gaps**2) / (2 * deviation**2)) / (deviation * np.sqrt(np.pi / 2))
        density /= erf(1 / (np.sqrt(2) * deviation))
        share = 0.5
        for _ in range(20):
            share = float(np.mean(share * density / (share * density + 1 - share)))
        log_likelihood = float(np.log(share * density + 1 - share).sum())
        if log_likelihood > largest:
            largest, likeliest = log_likelihood, float(deviation)
    return likeliest


def _cloud(
    frame: SeenFrame, rays: dict[int, Rays], sensors: Sequence[Sensor], noise: Floats, gates: Floats
) -> Cloud:
    points, detections, gaps = _meetings(rays, gates)
    measured, of_clouds = _measured(frame, sensors)
    points, detections = np.concatenate([points, measured]), np.concatenate([detections, of_clouds])
    gaps = np.append(gaps, np.zeros(len(of_clouds)))
    if len(frame.points) > (1 if len(of_clouds) else 2) and len(points):  # others may confirm
        detections = _supported(points, detections, gaps, frame, sensors, gates)
        kept = (detections >= 0).any(axis=1)
        points, detections = points[kept], detections[kept]
    points, sigma = _refined(points, detections, frame, sensors, noise)
    is_finite = np.isfinite(np.column_stack([points, sigma])).all(axis=1)
    rows = np.arange(np.count_nonzero(is_finite))
    return Cloud(points[is_finite], sigma[is_finite], detections[is_finite], rows, frame)


def _measured(frame: SeenFrame, sensors: Sequence[Sensor]) -> tuple[Floats, Indices]:
    """Return the points (P, 3) of clouds, in the world, and their detections (P, L)."""
    points, detections = [np.zeros((0, 3))], [np.zeros((0, len(sensors)), dtype=np.intp)]
    for k, measured in frame.points.items():
        if isinstance(sensor := sensors[k], CloudSensor):
            points.append(transform(inverse(sensor.T_sensor_world), measured))
            detections.append(np.full((len(measured), len(sensors)), -1))
            detections[-1][:, k] = np.arange(len(measured))
    return np.concatenate(points), np.concatenate(detections)


def _supported(
    points: Floats,
    detections: Indices,
    gaps: Floats,
    frame: SeenFrame,
    sensors: Sequence[Sensor],
    gates: Floats,
) -> Indices:
    """Return the detections (P, L) of all sensors that see the points; -1 throughout for ghosts."""
    # of points that share detections the one that most sensors confirm stays; a point of only two
    # cameras is a ghost if one of its detections belongs to a point of three or more, or of a cloud
    misfit, sensor_views = gaps.copy(), np.where(are_points(sensors), 3, 1)
    for sensor, pixels in frame.points.items():
        y, visible = sensors[sensor].project(points)
        distance, nearest = cKDTree(pixels).query(y)
        is_confirmed = visible & (distance < gates[sensor]) & (detections[:, sensor] < 0)
        detections[is_confirmed, sensor] = nearest[is_confirmed]
        misfit[is_confirmed] += distance[is_confirmed] / gates[sensor]
    views: Indices = np.asarray((detections >= 0) @ sensor_views, dtype=np.intp)
    taken = [set[int]() for _ in sensors]
    kept = np.zeros(len(points), dtype=np.bool_)
    for k in np.lexsort((misfit / views, -views)):
        of_point = [(s, d) for s, d in enumerate(detections[k].tolist()) if d >= 0]
        shared = sum(int(sensor_views[s]) for s, d in of_point if d in taken[s])
        if shared > max(views[k] - 3, 0):
            continue
        kept[k] = True
        if views[k] > 2:
            for s, d in of_point:
                taken[s].add(d)
    return np.where(kept[:, None], detections, -1)


def _refined(
    points: Floats, detections: Indices, frame: SeenFrame, sensors: Sequence[Sensor], noise: Floats
) -> tuple[Floats, Floats]:
    """Fit points (P, 3) to all their detections by least squares; also return deviations (P,)."""
    information = np.zeros((len(points), 3, 3))
    for _ in range(_STEPS if len(points) else 0):
        information, pull = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for sensor, pixels in frame.points.items():
            is_seen = detections[:, sensor] >= 0
            if not is_seen.any():
                continue
            y, J, visible = sensors[sensor].linearise(points[is_seen])
            J = J * visible[:, None, None] / noise[sensor]
            r = np.where(visible[:, None], pixels[detections[is_seen, sensor]] - y, 0.0)
            information[is_seen] += np.swapaxes(J, 1, 2) @ J
            pull[is_seen] += np.einsum("nmk,nm->nk", J, r / noise[sensor])
        finite: Mask = np.asarray(np.isfinite(information).all(axis=(1, 2)))
        values = np.linalg.eigvalsh(np.where(finite[:, None, None], information, 0.0))
        is_fixed = values[:, 0] > 1e-12 * values[:, 2]  # known in all directions
        information[~is_fixed] = np.nan
        step = np.full(points.shape, np.nan)
        step[is_fixed] = np.linalg.solve(information[is_fixed], pull[is_fixed][..., None])[..., 0]
        points = points + step
    is_known = np.isfinite(points).all(axis=1)
    sigma = np.full(len(points), np.nan)
    sigma[is_known] = 1 / np.sqrt(np.linalg.eigvalsh(information[is_known])[:, 0])
    return points, sigma


def gathered_places(
    points: Floats, reach: Floats, frame: Indices, least: float
) -> list[tuple[Floats, Indices]]:
    """Find places (3,) at which points (n, 3) of many frames are, and these points; most first.

    Points may be off by their reach (n,), standard deviations times the gate.  Frames (n,) with the
    same information share a number, and `least` different ones must show a place.  A place has at
    most one point of a frame, the nearest; points within three gates of it start no later place.
    """
    gathered: list[tuple[Floats, Indices]] = []
    if len(points) < least:
        return gathered
    typical = float(np.median(reach))
    allowed = np.maximum(reach, typical)
    tree = cKDTree(points)
    neighbours = tree.query_ball_point(points, 2 * typical)
    counts = np.array([len(np.unique(frame[rows])) for rows in neighbours])
    is_unused = np.ones(len(points), dtype=np.bool_)
    for k in np.argsort(-counts, kind="stable"):
        if counts[k] < least:
            break
        if not is_unused[k]:
            continue
        place = points[k]
        for _ in range(3):
            nearby = np.array(tree.query_ball_point(place, 3 * typical), dtype=np.intp)
            distance = np.linalg.norm(points[nearby] - place, axis=1)
            inside = nearby[distance <= allowed[nearby]]
            if not len(inside):
                break
            weight = 1 / reach[inside] ** 2
            place = weight @ points[inside] / weight.sum()
        distance = np.linalg.norm(points[nearby] - place, axis=1)
        is_unused[nearby] = is_unused[k] = False
        frames_nearby = len(np.unique(frame[nearby]))
        chosen = nearby[np.argsort(distance, kind="stable")]
        chosen = chosen[np.sort(distance) <= allowed[chosen]]
        _, first = np.unique(frame[chosen], return_index=True)
        chosen = chosen[np.sort(first)]
        if len(chosen) >= max(least, RULES.gathered * frames_nearby):
            gathered.append((place, chosen))
    return gathered


def without_still(clouds: Sequence[Cloud]) -> tuple[list[Cloud], list[Floats]]:
    """Return clouds without points that stand still, and the places of these.

    A body that rests in most of the frames is missing from these frames only.
    """
    points = np.concatenate([cloud.points for cloud in clouds])
    reach = RULES.gate * np.concatenate([cloud.sigma for cloud in clouds])
    frame = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    least = max(RULES.still_share * sum(len(cloud) > 0 for cloud in clouds), RULES.least_frames)
    still = gathered_places(points, reach, frame, least)
    detections = np.concatenate([cloud.detections for cloud in clouds])
    taken = np.concatenate([np.zeros(0, dtype=np.intp), *(chosen for _, chosen in still)])
    moving = [cloud.without(detections[taken[frame[taken] == k]]) for k, cloud in enumerate(clouds)]
    return moving, [place for place, _ in still]


def without_places(
    frame: SeenFrame, places: Sequence[Floats], sensors: Sequence[Sensor], gates: Floats
) -> SeenFrame:
    """Return a frame without detections within gates (L,) of where places (3,) are seen."""
    points = dict(frame.points)
    for sensor, pixels in frame.points.items():
        y, visible = sensors[sensor].project(np.array(places))
        distance = np.linalg.norm(pixels[:, None] - y[visible], axis=2)
        points[sensor] = pixels[(distance > gates[sensor]).all(axis=1)]
    return replace(frame, points=points)

"""How large markers look, and so which spots are cut, merged or something else.

A marker of radius R in an image whose scale is s (pixels per length at the feature, of a disk
along its plane) has a spot of radius sR.  What hides a part of it leaves r² of (sR)² of the area,
and moves the centroid by what is lost of the whole disk's moment: by sR (1 − r²/s²R²) where what is
lost lies at the rim, and as far where only a part at the rim is left.  What is larger is merged,
with the roles exchanged.

Whole spots scatter about their size by a deviation τ of its logarithm; cut ones have any size.
What glows has the size of the optics in each image: in logarithms a sensor's R is off the common
one by a deviation ω, small where sensors see disks.  R, τ and ω are learnt from the frames that
are ok; before the first nothing is known.  Of markers of told radii R is what they are times these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import DRAWING
from mixpose.judgement import ScoredPose
from mixpose.objective import View, project_body
from mixpose.records import Floats, Indices, Mask, PointPattern
from mixpose.rigid import cross

_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SizeRules:
    """What is believed of the sizes of spots."""

    cut: float = constant(
        0.02, "of spots whose shape does not show it: of 4,500 before a hand 1 % are 0.1 px off"
    )
    scatter: float = constant(0.1, "τ before it is seen: grey levels move outlines of small spots")
    scatter_counts: float = constant(6.0, "spots that this counts as: those of a frame")
    least: float = constant(0.01, "τ at least: disks of 6 px are as exact")
    apart: float = constant(0.05, "ω before it is seen: thresholds move outlines by as much")
    memory: float = constant(0.95, "per frame, as of noise")


@dataclass(frozen=True)
class Sizes:
    """Sums over spots that are likely whole: their number, logarithms of R, and squares."""

    count: float = 0.0
    mean: float = 0.0
    squares: float = 0.0  # about the centre of each sensor
    sensors: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # count and mean

    def scatter(self, rules: SizeRules) -> float:
        """τ."""
        prior = rules.scatter_counts
        variance = (self.squares + prior * rules.scatter**2) / (self.count + prior)
        return max(float(np.sqrt(variance)), rules.least)

    def centres(self, sensors: Sequence[str], rules: SizeRules) -> list[float]:
        """The logarithm of R in each sensor: its own mean, drawn to that of all by ω."""
        # of few spots each may be cut
        told = {
            name: (count / (count + rules.scatter_counts), count, mean - self.mean)
            for name, (count, mean) in self.sensors.items()
        }
        squares = sum([share * off * off for share, _, off in told.values()])
        apart = (rules.apart**2 + squares) / (1 + sum([share for share, *_ in told.values()]))
        own = [told.get(name, (0.0, 0.0, 0.0)) for name in sensors]
        least = rules.scatter**2 / apart
        return [self.mean + off * share * n / (share * n + least) for share, n, off in own]

    def cut(self, off: Floats, rules: SizeRules) -> Floats:
        """Chances (n,) that spots are cut or merged, by ln r/s less the sensor's centre (n,)."""
        tau = self.scatter(rules)
        whole = np.exp(-0.5 * (off / tau) ** 2) / (np.sqrt(2 * np.pi) * tau)
        cut = rules.cut * np.exp(-np.abs(off))
        return np.asarray(cut / (cut + (1 - rules.cut) * whole))

    def followed(self, logs: Mapping[str, Floats], rules: SizeRules) -> Sizes:
        """With the spots (n,) of one more frame, by sensor."""
        logs = {name: own for name, own in logs.items() if own.size}
        if not logs:
            return self
        known = (
            self if self.count else Sizes(0.0, float(np.median(np.concatenate([*logs.values()]))))
        )
        # where a sensor was not seen before, most of its spots are whole
        begun = {name: (float(own.size), float(np.median(own))) for name, own in logs.items()}
        known = replace(known, sensors=begun | dict(known.sensors))
        sensors = {name: (rules.memory * n, mean) for name, (n, mean) in self.sensors.items()}
        count, squares = rules.memory * self.count, rules.memory * self.squares
        for (name, own), centre in zip(logs.items(), known.centres([*logs], rules), strict=True):
            weights = 1 - known.cut(own - centre, rules)
            before, mean = sensors.get(name, (0.0, begun[name][1]))
            after = before + float(weights.sum())
            mean += float(weights @ (own - mean)) / max(after, 1e-12)
            sensors[name] = after, mean
            count += float(weights.sum())
            squares += float(weights @ (own - mean) ** 2)
        if count <= 0:
            return self
        mean = sum([n * own for n, own in sensors.values()]) / count
        return Sizes(count, mean, squares, sensors)


def weighed_by_size(
    views: Sequence[View], body: Body, T_world_object: Floats, sizes: Sizes, rules: SizeRules
) -> list[View]:
    """Views with the deviations of spots that have not the size of the nearest feature."""
    if not (sizes.count and rules.cut and views):
        return list(views)
    at = project_body(tuple(view.sensor for view in views), body).project(T_world_object[None])
    seen_otherwise, scatter = list(views), sizes.scatter(rules)
    every = _scales(at.J[:, 0], T_world_object, body) * _by_radius(body.node_radii)
    centres = sizes.centres([view.name for view in views], rules)
    for k, (view, centre) in enumerate(zip(views, centres, strict=True)):
        pattern = view.observation.pattern
        if not isinstance(pattern, PointPattern) or not (pattern.has_radii and at.seen[k].any()):
            continue
        (seen,) = at.seen[k, 0].nonzero()
        scales = every[k, seen[_nearest(pattern.points, at.y[k, 0, seen])]]
        off, whole = np.log(pattern.radii / scales) - centre, scales * np.exp(centre)
        smaller = np.exp(-2 * np.hypot(off, scatter))
        # of each of two coordinates
        moved = np.maximum(pattern.radii, whole) * (1 - smaller) / np.sqrt(2)
        # what is likely whole is not made less exact by a little
        chances = sizes.cut(off, rules)
        own = np.where(chances > 0.5, moved, 0.0)
        cut = np.array([chances, moved]).T
        known = pattern.with_errors(np.maximum(pattern.deviations, own), cut)
        seen_otherwise[k] = replace(view, observation=replace(view.observation, pattern=known))
    return seen_otherwise


def _nearest(points: Floats, places: Floats) -> Indices:
    """Which of places (n, 2) is nearest to each of points (M, 2)."""
    if len(points) * len(places) > DRAWING.few_pairs:
        return np.asarray(cKDTree(places).query(points)[1])
    away = points[:, None] - places
    return np.asarray(np.vecdot(away, away).argmin(axis=1))


def are_cut_otherwise(views: Sequence[View], known: Sequence[View]) -> bool:
    """Whether other spots of views are known to be cut, or merged, by their sizes."""
    return any(
        bool((_are_cut(one) ^ _are_cut(other)).any())
        for one, other in zip(views, known, strict=True)
        if isinstance(one.observation.pattern, PointPattern)
    )


def _are_cut(view: View) -> Mask:
    """Which spots (M,) are likely cut or merged, by their sizes."""
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    return np.zeros(pattern.size, bool) if pattern.cut is None else pattern.cut[:, 0] > 0.5


def sizes_after(before: Sizes, best: ScoredPose, body: Body, rules: SizeRules) -> Sizes:
    """What is known after a frame that is ok."""
    used = best.used
    met = (used.radii > 0) & (used.shares == used.weights) & (used.shares > 0)
    if not before.count:
        met &= used.extra < best.variances[:, None]  # of no shape that is odd
    if not np.count_nonzero(met):
        return before
    scales = _scales(used.J * used.sigmas[:, None, None, None], best.T_world_object, body)
    scales *= _by_radius(body.node_radii)
    logs = {
        name: np.log(radii[own] / scale[own])
        for name, radii, scale, own in zip(used.names, used.radii, scales, met)
    }
    return before.followed(logs, rules)


def _by_radius(radii: Floats | None) -> Floats | float:
    """How large markers are told to be (N,), by their geometric mean."""
    if radii is None or not radii.all():
        return 1.0
    return np.asarray(radii / np.exp(np.log(radii).mean()))


def _scales(J: Floats, T_world_object: Floats, body: Body) -> Floats:
    """Pixels per length (..., N) by Jacobians (..., N, 2, 6) of places by the pose.

    Roots of areas: of a disk of its own plane, of anything else across the line of sight.
    """
    across = cross(J[..., 0, :3].T, J[..., 1, :3].T).T
    if body.shape == "disk" and body.node_normals is not None:
        areas = np.abs(np.vecdot(across, body.node_normals @ T_world_object[:3, :3].T))
    else:
        areas = np.linalg.norm(across, axis=-1)
    return np.asarray(np.sqrt(np.maximum(areas, _TINY)))

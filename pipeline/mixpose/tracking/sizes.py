"""Sizes of markers in images, and so which spots are cut, merged or something else.

A marker of radius R in an image whose scale is s (pixels per length at the feature, of a disk along
its plane) has a spot of radius sR.  Hiding a part leaves r² of the area (sR)², and moves the
centroid by the lost moment over the whole disk's area: by sR (1 − r²/s²R²) if the lost part lies at
the rim, and as far if only a part at the rim is left.  A larger spot is merged, with the roles
exchanged.

Whole spots scatter about their size by a deviation τ of its logarithm; cut ones have any size.
Glowing markers look as large as the optics of each image make them: in logarithms a sensor's R
deviates from the common one by ω, small where sensors see disks.  R, τ and ω are learnt from ok
frames; before the first nothing is known.  Configured radii of markers are factors of R.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import nearest_of
from mixpose.judgement import ScoredPose
from mixpose.objective import View, project_body
from mixpose.records import Floats, Mask, PointPattern, replace
from mixpose.rigid import cross

_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SizeRules:
    """What is assumed about the sizes of spots."""

    cut: float = constant(
        0.02, "of spots whose shape does not show it: of 4,500 before a hand 1 % are 0.1 px off"
    )
    scatter: float = constant(0.1, "τ before it is seen: grey levels move outlines of small spots")
    scatter_counts: float = constant(6.0, "spots that this counts as: those of a frame")
    least: float = constant(0.01, "τ at least: disks of 6 px are as exact")
    apart: float = constant(0.05, "ω before it is seen: thresholds move outlines by as much")
    memory: float = constant(0.95, "per frame, as of noise")
    exposed: float = constant(
        1e-3, "of frames in which a sensor shows all spots larger or smaller than before"
    )


@dataclass(frozen=True)
class Sizes:
    """Sums over probably whole spots: their number, logarithms of R, and squares."""

    count: float = 0.0
    mean: float = 0.0
    squares: float = 0.0  # about the centre of each sensor
    sensors: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # count and mean

    def scatter(self, rules: SizeRules) -> float:
        """Return τ."""
        prior = rules.scatter_counts
        variance = (self.squares + prior * rules.scatter**2) / (self.count + prior)
        return max(float(np.sqrt(variance)), rules.least)

    def centres(self, sensors: Sequence[str], rules: SizeRules) -> list[float]:
        """Return the logarithm of R in each sensor: its mean, drawn to the common mean by ω."""
        # each of few spots may be cut
        terms = {
            name: (count / (count + rules.scatter_counts), count, mean - self.mean)
            for name, (count, mean) in self.sensors.items()
        }
        squares = sum([share * offset * offset for share, _, offset in terms.values()])
        variance = (rules.apart**2 + squares) / (1 + sum([share for share, *_ in terms.values()]))
        chosen = [terms.get(name, (0.0, 0.0, 0.0)) for name in sensors]
        least = rules.scatter**2 / variance
        return [self.mean + offset * share * n / (share * n + least) for share, n, offset in chosen]

    def cut(self, off: Floats, rules: SizeRules) -> Floats:
        """Return chances (n,) that spots are cut or merged, by ln r/s minus the centre (n,)."""
        tau = self.scatter(rules)
        return np.asarray(rules.cut * np.exp(-np.abs(off)) / _density(off, tau, rules))

    def centre_now(self, logs: Floats, centre: float, rules: SizeRules) -> float:
        """Return the centre of a frame's spots (n,): another one if light or exposure changed.

        Cut spots have any size; spots that are all as much larger or smaller are whole.
        """
        tau = self.scatter(rules)
        if 2 * np.count_nonzero(np.abs(logs - centre) < 3 * tau) >= logs.size:  # as is the median
            return centre
        now = float(np.median(logs))
        before, after = (float(np.log(_density(logs - c, tau, rules)).sum()) for c in (centre, now))
        # the median agrees with one spot by itself
        by_chance = float(np.log(_density(np.zeros(1), tau, rules))[0])
        return now if after - before - by_chance > -np.log(rules.exposed) else centre

    def followed(self, logs: Mapping[str, Floats], rules: SizeRules) -> Sizes:
        """Return the sums with the spots (n,) of one more frame, by sensor."""
        logs = {name: values for name, values in logs.items() if values.size}
        if not logs:
            return self
        known = (
            self if self.count else Sizes(0.0, float(np.median(np.concatenate([*logs.values()]))))
        )
        # in a new sensor most spots are assumed to be whole
        new = {name: v for name, v in logs.items() if name not in known.sensors}
        first = {name: (float(v.size), float(np.median(v))) for name, v in new.items()}
        known = replace(known, sensors=first | dict(known.sensors))
        sensors = {name: (rules.memory * n, mean) for name, (n, mean) in self.sensors.items()}
        count, squares = rules.memory * self.count, rules.memory * self.squares
        for (name, values), centre in zip(logs.items(), known.centres([*logs], rules), strict=True):
            now = known.centre_now(values, centre, rules)
            weights = 1 - known.cut(values - now, rules)
            before, mean = sensors[name] if name in sensors else (0.0, first[name][1])
            if now != centre:
                before, mean = 0.0, now
            after = before + float(weights.sum())
            mean += float(weights @ (values - mean)) / max(after, 1e-12)
            sensors[name] = after, mean
            count += float(weights.sum())
            squares += float(weights @ (values - mean) ** 2)
        if count <= 0:
            return self
        mean = sum([n * mean for n, mean in sensors.values()]) / count
        return Sizes(count, mean, squares, sensors)


def _density(off: Floats, tau: float, rules: SizeRules) -> Floats:
    """Return densities (n,) of spots, whole or not, by ln r/s minus the centre (n,)."""
    whole = np.exp(-0.5 * (off / tau) ** 2) / (np.sqrt(2 * np.pi) * tau)
    return np.asarray(rules.cut * np.exp(-np.abs(off)) + (1 - rules.cut) * whole)


def weighed_by_size(
    views: Sequence[View], body: Body, T_world_object: Floats, sizes: Sizes, rules: SizeRules
) -> list[View]:
    """Return views with larger deviations of spots whose size does not fit their feature."""
    if not (sizes.count and rules.cut and views):
        return list(views)
    images = project_body(tuple(view.sensor for view in views), body).project(T_world_object[None])
    seen_otherwise, scatter = list(views), sizes.scatter(rules)
    all_scales = _scales(images.J[:, 0], T_world_object, body) * _by_radius(body.node_radii)
    centres = sizes.centres([view.name for view in views], rules)
    for k, (view, centre) in enumerate(zip(views, centres, strict=True)):
        pattern = view.observation.pattern
        (seen,) = images.seen[k, 0].nonzero()
        if not (isinstance(pattern, PointPattern) and pattern.has_radii and seen.size):
            continue
        _, nearest = nearest_of(pattern.points, images.y[k, 0, seen])
        scales = all_scales[k, seen[nearest]]
        logs = np.log(pattern.radii / scales)
        now = sizes.centre_now(logs, centre, rules)
        off, whole = logs - now, scales * np.exp(now)
        smaller = np.exp(-2 * np.hypot(off, scatter))
        # per coordinate, of two
        moved = np.maximum(pattern.radii, whole) * (1 - smaller) / np.sqrt(2)
        # a probably whole spot is not made slightly less exact
        chances = sizes.cut(off, rules)
        deviations = np.where(chances > 0.5, moved, 0.0)
        cut = np.array([chances, moved]).T
        known = pattern.with_errors(np.maximum(pattern.deviations, deviations), cut)
        seen_otherwise[k] = replace(view, observation=replace(view.observation, pattern=known))
    return seen_otherwise


def are_cut_otherwise(views: Sequence[View], known: Sequence[View]) -> bool:
    """Test whether other spots of views are cut or merged, by their sizes."""
    return any(
        bool((_are_cut(old) ^ _are_cut(new)).any())
        for old, new in zip(views, known, strict=True)
        if isinstance(old.observation.pattern, PointPattern)
    )


def _are_cut(view: View) -> Mask:
    """Return which spots (M,) are probably cut or merged, by their sizes."""
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    return np.zeros(pattern.size, bool) if pattern.cut is None else pattern.cut[:, 0] > 0.5


def sizes_after(before: Sizes, best: ScoredPose, body: Body, rules: SizeRules) -> Sizes:
    """Return the statistics of sizes after an ok frame."""
    used = best.used
    met = (used.radii > 0) & (used.shares == used.weights) & (used.shares > 0)
    if not before.count:
        met &= used.extra < best.variances[:, None]  # and no odd shape
    if not np.count_nonzero(met):
        return before
    scales = _scales(used.J * used.sigmas[:, None, None, None], best.T_world_object, body)
    scales *= _by_radius(body.node_radii)
    logs = {
        name: np.log(radii[chosen] / scale[chosen])
        for name, radii, scale, chosen in zip(used.names, used.radii, scales, met)
    }
    return before.followed(logs, rules)


def _by_radius(radii: Floats | None) -> Floats | float:
    """Return the configured sizes of markers (N,) over their geometric mean."""
    if radii is None or not radii.all():
        return 1.0
    return np.asarray(radii / np.exp(np.log(radii).mean()))


def _scales(J: Floats, T_world_object: Floats, body: Body) -> Floats:
    """Return pixels per length (..., N) by Jacobians (..., N, 2, 6) of places by the pose.

    Roots of areas: of a disk in its own plane, of anything else across the line of sight.
    """
    across = cross(J[..., 0, :3].T, J[..., 1, :3].T).T
    if body.shape == "disk" and body.node_normals is not None:
        areas = np.abs(np.vecdot(across, body.node_normals @ T_world_object[:3, :3].T))
    else:
        areas = np.linalg.norm(across, axis=-1)
    return np.asarray(np.sqrt(np.maximum(areas, _TINY)))

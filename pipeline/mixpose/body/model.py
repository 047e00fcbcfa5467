"""The object model: q = (1/N) Σ q_i, a mixture of feature densities."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import ndtri

from mixpose.body import symmetry
from mixpose.body.features import Feature, Sampler, uniforms
from mixpose.records import Floats, Indices

Shape: TypeAlias = Literal["point", "sphere", "disk"]

RECURRENT = 0.6
"""Least share of features that a grid step maps onto features, so that tracking may slip by it: the
steps of a chessboard of 6 × 9 corners have 0.8, those of markers at random 1/N."""


@dataclass(frozen=True)
class Nodes:
    """Weighted points that represent the body where it is not sampled."""

    points: Floats  # (Q, 3)
    weights: Floats  # (Q,) that sum to 1 per feature, and to N in all
    feature: Indices  # (Q,) number of the feature that a node belongs to


@dataclass(frozen=True)
class Gravity:
    """Displacements of features along a direction of the world, in any orientation of the body."""

    direction: Floats  # (3,) in the world, of any length
    sigma: float  # standard deviation of a displacement, length units

    @property
    def unit(self) -> Floats:
        """The direction (3,), of length 1."""
        direction = np.asarray(self.direction, dtype=np.float64)
        return np.asarray(direction / np.linalg.norm(direction))

    @property
    def covariance(self) -> Floats:
        """Covariance (3, 3) of the displacement of a feature in the world."""
        return np.asarray(self.sigma**2 * np.outer(self.unit, self.unit))


EDGE_ON = math.cos(math.radians(80.0))
"""Cosine of the angle between normal and line of sight beyond which no flat feature is detected.

In four real recordings 46 % of the corners of printed tags are detected between 75 and 80 degrees,
4 % of 2,700 between 80 and 85 degrees, and none of 2,100 beyond.
"""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body known by its features."""

    name: str
    features: tuple[Feature, ...]  # the densities q_i in the object's frame
    normals: Floats | None = None  # (N, 3) outward: only sensors that a feature faces see it
    gravity: Gravity | None = None  # spread along an axis of the world
    # of the markers: the centre of the image of a sphere or disk is not the image of its centre
    shape: Shape = "point"  # disks are perpendicular to their normals
    radii: Floats | None = None  # (N,) of spheres or disks, length units; 0 for a point
    names: tuple[str, ...] = ()  # of the first features; the others have none
    tip: Floats | None = None  # (3,) that pose lines report, too; it is no feature

    def __len__(self) -> int:
        return len(self.features)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Labels (N) of the features in messages: names, else numbers from 1."""
        return self.names + tuple(str(i + 1) for i in range(len(self.names), len(self)))

    @cached_property
    def means(self) -> Floats:
        """Expected feature positions (N, 3)."""
        return np.array([feature.mean for feature in self.features])

    @cached_property
    def covariances(self) -> Floats:
        """Spreads Σ_i (N, 3, 3)."""
        return np.array([feature.covariance for feature in self.features])

    @cached_property
    def nodes(self) -> Nodes:
        """Weighted points that represent the features."""
        parts = [feature.nodes() for feature in self.features]
        counts = [len(weights) for _, weights in parts]
        return Nodes(
            points=np.concatenate([points for points, _ in parts]),
            weights=np.concatenate([weights for _, weights in parts]),
            feature=np.repeat(np.arange(len(parts)), counts),
        )

    @property
    def edge_on(self) -> float:
        """Cosine of the angle to its normal beyond which a feature is not seen."""
        return 0.0 if self.shape == "sphere" else EDGE_ON

    @cached_property
    def node_normals(self) -> Floats | None:
        """Normals of the nodes (Q, 3); None if the body has none."""
        return None if self.normals is None else self.normals[self.nodes.feature]

    @cached_property
    def surfaces(self) -> Indices | None:
        """Numbers (Q,) of surfaces, shared by nodes of one normal; None without normals."""
        if self.node_normals is None:
            return None
        return np.unique(self.node_normals, axis=0, return_inverse=True)[1].reshape(-1)

    @cached_property
    def node_radii(self) -> Floats | None:
        """Radii of the nodes (Q,); None for a body of points."""
        return None if self.radii is None else self.radii[self.nodes.feature]

    @cached_property
    def is_exact(self) -> bool:
        """Whether all features are deltas, so that no sampling is needed."""
        sharp = len(self.nodes.points) == len(self) and not self.covariances.any()
        return sharp and self.gravity is None

    @cached_property
    def radius(self) -> float:
        """Largest distance of a node from the centre of the means."""
        away = self.nodes.points - self.means.mean(axis=0)
        return float(np.linalg.norm(away, axis=1).max())

    @cached_property
    def spread(self) -> float:
        """Largest standard deviation of any feature in any direction, at any pose."""
        sag = self.gravity.sigma if self.gravity is not None else 0.0
        return float(np.hypot(self._widest, sag))

    @cached_property
    def _widest(self) -> float:
        """Largest standard deviation of spreads that turn with the body."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariances).max(), 0.0)))

    def feature_spreads(self, T_world_object: Floats) -> Floats:
        """Return spreads Σ_i (..., N, 3, 3) of features in the world at poses (..., 4, 4)."""
        R = T_world_object[..., None, :3, :3]
        spreads = R @ self.covariances @ R.swapaxes(-1, -2)
        return np.asarray(spreads if self.gravity is None else spreads + self.gravity.covariance)

    def node_spreads(self, T_world_object: Floats) -> Floats:
        """Return spreads (Q, 3, 3) of the nodes in the world at a pose (4, 4)."""
        return np.asarray(self.feature_spreads(T_world_object)[self.nodes.feature])

    @cached_property
    def symmetries(self) -> Floats:
        """Motions T_object_object (G, 4, 4) that map features and normals onto themselves."""
        points = self.nodes.points
        tolerance = max(symmetry.default_tolerance(points), self._widest)
        maps = symmetry.symmetries(points, tolerance)
        if self.node_normals is None:
            return maps
        return maps[[symmetry.are_normals_kept(T, points, self.node_normals) for T in maps]]

    @cached_property
    def asymmetry(self) -> float:
        """Largest distance of a node, moved by a symmetry, to the nearest; 0 if it is rounding."""
        return symmetry.farthest_apart(self.symmetries, self.nodes.points)

    @cached_property
    def identity(self) -> int:
        """Number of the symmetry that is the identity."""
        away = np.abs(self.symmetries - np.eye(4)).max(axis=(1, 2))
        return int(away.argmin())

    @cached_property
    def centred(self) -> Body:
        """The same body with its origin in the middle of its features, and no tip."""
        centre = self.means.mean(axis=0)
        features = tuple(feature.shifted(-centre) for feature in self.features)
        return replace(self, features=features, tip=None)

    @cached_property
    def grid_steps(self) -> Floats:
        """Shifts (S, 3) that map most features onto others, such as the steps of a chessboard."""
        tolerance = max(symmetry.default_tolerance(self.means), self._widest)
        return symmetry.grid_steps(self.means, tolerance, RECURRENT)

    def sample(
        self,
        count: int,
        *,
        sampler: Sampler = "latin-hypercube",
        antithetic: bool = True,
        common: bool = True,
        seed: int = 0,
    ) -> Floats:
        """Draw R = `count` samples (N, R, 3) of every feature density, or one if it is exact.

        Antithetic samples come in mirrored pairs.  Features share one set of uniform numbers if
        `common`; separate sets are for comparison only.
        """
        if self.is_exact:
            return self.means[:, None, :].copy()
        drawn = partial(uniforms, count, sampler=sampler, antithetic=antithetic)
        sets = [drawn(seed=seed)] * len(self)
        if not common:
            sets = [drawn(seed=seed + 7919 * i) for i in range(len(self))]
        pairs = zip(self.features, sets, strict=True)
        return np.array([feature.sample(numbers) for feature, numbers in pairs])

    def world_offsets(self, count: int, *, seed: int = 0) -> Floats:
        """Draw displacements (R, 3) along gravity in the world for the samples of a feature.

        They are zero without gravity, and belong to the samples of the same count and seed.
        """
        if self.gravity is None:
            return np.zeros((1 if self.is_exact else 2 * (count // 2), 3))
        drawn = uniforms(count, seed=seed)[:, 4]
        return np.asarray(self.gravity.sigma * ndtri(drawn)[:, None] * self.gravity.unit)

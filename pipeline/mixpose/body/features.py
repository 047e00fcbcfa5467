"""Kinds of feature: the densities q_i of where a feature of the object may be.

A feature kind states its mean and covariance, how uniform numbers become samples of it, and the
few weighted points that stand for it where the body is not sampled (`nodes`).  A new kind is one
class with these members.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from scipy.special import ndtri

from mixpose.records import Floats

Spread: TypeAlias = Literal["gaussian", "uniform"]

SEGMENT_NODES = 24


@runtime_checkable
class Feature(Protocol):
    """A feature density q_i in the object's frame."""

    @property
    def spread(self) -> Spread:
        """Density of the spread about the nodes."""
        ...

    @property
    def mean(self) -> Floats:
        """Expected position (3,)."""
        ...

    @property
    def covariance(self) -> Floats:
        """Spread about the nodes (3, 3); zero where the feature is exact."""
        ...

    def nodes(self) -> tuple[Floats, Floats]:
        """Points (K, 3) and weights (K,), summing to 1, that carry the spread."""
        ...

    def shifted(self, by: Floats) -> Feature:
        """The same elsewhere, by a shift (3,)."""
        ...

    def sample(self, uniforms: Floats) -> Floats:
        """Turn uniform numbers (R, 5) in (0, 1) into samples (R, 3) of the density.

        The first three are for the spread, the fourth runs along a line, the fifth is the body's.
        """
        ...


def no_spread() -> Floats:
    """The covariance of an exactly known feature."""
    return np.zeros((3, 3))


@dataclass(frozen=True)
class PointFeature:
    """A point: exact (delta), Gaussian, q_i = N(z_i, Σ_i), or uniform in a box."""

    position: Floats  # (3,)
    covariance: Floats = field(default_factory=no_spread)  # (3, 3) Σ_i; zero for a delta
    spread: Spread = "gaussian"  # with that covariance; a box is along its principal axes

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", np.asarray(self.position, dtype=np.float64))
        object.__setattr__(self, "covariance", np.asarray(self.covariance, dtype=np.float64))

    @property
    def mean(self) -> Floats:
        """Expected position (3,)."""
        return self.position

    def nodes(self) -> tuple[Floats, Floats]:
        """The position itself."""
        return self.position[None], np.ones(1)

    def shifted(self, by: Floats) -> PointFeature:
        """The same elsewhere."""
        return replace(self, position=self.position + by)

    def sample(self, uniforms: Floats) -> Floats:
        """Samples (R, 3) of the density from uniform numbers (R, 5)."""
        return self.position + offsets(uniforms, self.covariance, self.spread)


@dataclass(frozen=True)
class SegmentFeature:
    """A straight line, uniform along its length, blurred by its spread."""

    start: Floats  # (3,)
    end: Floats  # (3,)
    # (3, 3) about the line; zero for a sharp one
    covariance: Floats = field(default_factory=no_spread)
    spread: Spread = "gaussian"

    def __post_init__(self) -> None:
        for name in ("start", "end", "covariance"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))

    @property
    def mean(self) -> Floats:
        """Expected position (3,), the middle of the line."""
        return np.asarray((self.start + self.end) / 2)

    def nodes(self) -> tuple[Floats, Floats]:
        """Midpoints of equal pieces of the line."""
        along = (np.arange(SEGMENT_NODES) + 0.5)[:, None] / SEGMENT_NODES
        weights = np.full(SEGMENT_NODES, 1.0 / SEGMENT_NODES)
        return self.start + along * (self.end - self.start), weights

    def shifted(self, by: Floats) -> SegmentFeature:
        """The same elsewhere."""
        return replace(self, start=self.start + by, end=self.end + by)

    def sample(self, uniforms: Floats) -> Floats:
        """Samples (R, 3) from uniform numbers (R, 5); the fourth runs along the line."""
        on_line = self.start + uniforms[:, 3:4] * (self.end - self.start)
        return on_line + offsets(uniforms, self.covariance, self.spread)


def offsets(uniforms: Floats, covariance: Floats, spread: Spread) -> Floats:
    """Zero-mean offsets (R, 3) of a covariance from the first three of uniform numbers (R, 5)."""
    if not covariance.any():
        return np.zeros((len(uniforms), 3))
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    if spread == "gaussian":
        unit = ndtri(uniforms[:, :3])
    else:
        unit = np.sqrt(12.0) * (uniforms[:, :3] - 0.5)
    return np.asarray(unit @ root.T)

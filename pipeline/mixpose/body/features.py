"""Define kinds of features: densities q_i of the position of a feature in the object's frame.

A kind has a mean, nodes (a few weighted points that represent it where the body is not sampled), a
covariance about these, and a map from uniform numbers to samples.

All features take the *same* set of uniform numbers: sampling errors then shift all features alike
instead of deforming the body, which makes the angles of an estimate several times more accurate at
the same number of samples.  Antithetic sets (u and 1 − u) cancel the mean error of symmetric
densities.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import ndtri

from mixpose.records import Floats

Spread: TypeAlias = Literal["gaussian", "uniform"]
Sampler: TypeAlias = Literal["latin-hypercube", "low-discrepancy"]

SEGMENT_NODES = 24
_DIMENSIONS = 5  # three for a feature's spread, one along a line, one along gravity


def no_spread() -> Floats:
    """Return the covariance of an exactly known feature."""
    return np.zeros((3, 3))


@dataclass(frozen=True)
class PointFeature:
    """A point: exact (delta), Gaussian, q_i = N(z_i, Σ_i), or uniform in a box."""

    position: Floats  # (3,)
    covariance: Floats = field(default_factory=no_spread)  # (3, 3) Σ_i; zero for a delta
    spread: Spread = "gaussian"  # or a box along the principal axes of the covariance

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", np.asarray(self.position, dtype=np.float64))
        object.__setattr__(self, "covariance", np.asarray(self.covariance, dtype=np.float64))

    @property
    def mean(self) -> Floats:
        """Expected position (3,)."""
        return self.position

    def nodes(self) -> tuple[Floats, Floats]:
        """Return the position, with weight 1."""
        return self.position[None], np.ones(1)

    def shifted(self, by: Floats) -> PointFeature:
        """Return the feature shifted by a vector (3,)."""
        return replace(self, position=self.position + by)

    def sample(self, uniforms: Floats) -> Floats:
        """Map uniform numbers (R, 5) to samples (R, 3) of the density."""
        return self.position + offsets(uniforms, self.covariance, self.spread)


@dataclass(frozen=True)
class SegmentFeature:
    """A straight line, uniform along its length, blurred by its spread."""

    start: Floats  # (3,)
    end: Floats  # (3,)
    covariance: Floats = field(default_factory=no_spread)  # (3, 3) about the line; zero if sharp
    spread: Spread = "gaussian"

    def __post_init__(self) -> None:
        for name in ("start", "end", "covariance"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))

    @property
    def mean(self) -> Floats:
        """Expected position (3,), the middle of the line."""
        return np.asarray((self.start + self.end) / 2)

    def nodes(self) -> tuple[Floats, Floats]:
        """Return the midpoints of equal pieces of the line, and their weights."""
        along = (np.arange(SEGMENT_NODES) + 0.5)[:, None] / SEGMENT_NODES
        weights = np.full(SEGMENT_NODES, 1.0 / SEGMENT_NODES)
        return self.start + along * (self.end - self.start), weights

    def shifted(self, by: Floats) -> SegmentFeature:
        """Return the feature shifted by a vector (3,)."""
        return replace(self, start=self.start + by, end=self.end + by)

    def sample(self, uniforms: Floats) -> Floats:
        """Map uniform numbers (R, 5) to samples (R, 3); the fourth number runs along the line."""
        on_line = self.start + uniforms[:, 3:4] * (self.end - self.start)
        return on_line + offsets(uniforms, self.covariance, self.spread)


Feature: TypeAlias = PointFeature | SegmentFeature


def offsets(uniforms: Floats, covariance: Floats, spread: Spread) -> Floats:
    """Map the first three of uniform numbers (R, 5) to zero-mean offsets (R, 3) of a covariance."""
    if not covariance.any():
        return np.zeros((len(uniforms), 3))
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    if spread == "gaussian":
        unit = ndtri(uniforms[:, :3])
    else:
        unit = np.sqrt(12.0) * (uniforms[:, :3] - 0.5)
    return np.asarray(unit @ root.T)


def uniforms(
    count: int, *, sampler: Sampler = "latin-hypercube", antithetic: bool = True, seed: int = 0
) -> Floats:
    """Draw R = `count` points (R, 5) of the open unit cube, strictly between 0 and 1.

    Latin hypercube is the paper's `lhsnorm`, low-discrepancy a scrambled Sobol sequence.  Of
    antithetic points, one less if odd, the second half mirrors the first.  Raises `ValueError` if
    the count is below 2 or the sampler is unknown.
    """
    if count < 2:
        raise ValueError(f"{count} samples, at least 2 are needed")
    from scipy.stats import qmc  # noqa: PLC0415 - scipy.stats takes a second to import

    drawn = count // 2 if antithetic else count
    rng = np.random.default_rng(seed)
    if sampler == "latin-hypercube":
        points = qmc.LatinHypercube(_DIMENSIONS, rng=rng).random(drawn)
    elif sampler == "low-discrepancy":
        # Sobol points are balanced only in powers of two: draw the next one and keep the first
        exponent = int(np.ceil(np.log2(max(drawn, 2))))
        points = qmc.Sobol(_DIMENSIONS, rng=rng).random_base2(exponent)[:drawn]
    else:
        raise ValueError(f"sampler {sampler!r}, allowed are latin-hypercube, low-discrepancy")
    if antithetic:
        points = np.concatenate([points, 1.0 - points])
    smallest = np.finfo(np.float64).eps
    return np.asarray(np.clip(points, smallest, 1.0 - smallest), dtype=np.float64)

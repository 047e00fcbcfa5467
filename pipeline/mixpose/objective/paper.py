"""The paper's objectives, sampled: formula (4) and the product it warns of.

* `PaperObjective`: (1/NR) Σ_i Σ_r Π_l g_l(p(z_ir; β, γ_l)).  The product over sensors stands
  inside, because all sensors see the same Z; with one sensor it is formula (2).
* `IndependentObjective`: Π_l (1/NR) Σ_i Σ_r g_l(p(z_ir; β, γ_l)), for comparison only.

Densities are looked up with `cv2.remap`, batched over poses.  A feature that a sensor cannot see
has density 0 there.  Curvatures are those of mean-shift: every sample pulls with the weight of
its density, as if its feature were a Gaussian of the level's σ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import Density
from mixpose.objective.base import Quadratic, View, pose_jacobian, region_of_interest
from mixpose.rigid import transform
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

REACH = 4.0
"""Margin of a window around the predicted samples, in standard deviations of a feature."""

_POSES_AT_ONCE = 64  # bounds the memory of a batch: 64 poses of 6000 samples are 10 MB


@dataclass(frozen=True)
class SampledTerm:
    """A sensor with its density g_l (with gradient) at one level of blur."""

    sensor: Sensor
    density: Density


@dataclass(frozen=True)
class _Sampled:
    """Densities of all samples in one sensor: values (S,) and pulls by the pose (S, 6)."""

    values: Floats
    by_pose: Floats
    J: Floats
    sigma: float


class _SampledObjective:
    """What both objectives share: samples of q and their densities.

    Parameters
    ----------
    terms : sequence of SampledTerm
    samples : (N, R, 3) array
        Samples z_ir of every feature, in the object's frame.
    world_offsets : (R, 3) array or None
        Displacements in the world that belong to the samples, as by gravity: they do not turn
        with the pose.
    """

    def __init__(
        self,
        terms: Sequence[SampledTerm],
        samples: Floats,
        world_offsets: Floats | None = None,
    ) -> None:
        self.terms = tuple(terms)
        self.points = samples.reshape(-1, 3)
        offsets = np.zeros((1, 3)) if world_offsets is None else world_offsets
        self.offsets = np.broadcast_to(offsets, samples.shape).reshape(-1, 3)

    def densities(self, T_world_object: Floats) -> list[Floats]:
        """g_l at all samples (..., S), per sensor."""
        points = transform(T_world_object, self.points) + self.offsets
        looked_up = []
        for term in self.terms:
            y, _ = term.sensor.project(points)
            g = term.density.sample(y)
            looked_up.append((g[..., 0] if g.ndim == y.ndim else g).astype(np.float64))
        return looked_up

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        poses = T_world_object.reshape(-1, 4, 4)
        parts = [
            self._combine(self.densities(poses[k : k + _POSES_AT_ONCE]))
            for k in range(0, len(poses), _POSES_AT_ONCE)
        ]
        return np.concatenate(parts).reshape(T_world_object.shape[:-2])

    def _combine(self, densities: list[Floats]) -> Floats:
        raise AssertionError("an objective says how sensors combine")

    def _linearised(self, T_world_object: Floats) -> list[_Sampled]:
        points = transform(T_world_object, self.points) + self.offsets
        result = []
        for term in self.terms:
            y, by_world, _ = term.sensor.linearise(points)
            J = pose_jacobian(by_world, T_world_object, self.points)
            g = term.density.sample(y).astype(np.float64)
            by_pose = np.einsum("sm,smk->sk", g[:, 1:], J)
            result.append(_Sampled(g[:, 0], by_pose, J, term.density.sigma))
        return result


class PaperObjective(_SampledObjective):
    """Formula (4): sensors multiplied inside the integral over the object."""

    def _combine(self, densities: list[Floats]) -> Floats:
        return np.asarray(np.prod(densities, axis=0).mean(axis=-1))

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and mean-shift curvature at one pose (4, 4)."""
        parts = self._linearised(T_world_object)
        product = np.prod([part.values for part in parts], axis=0)
        gradient, curvature = np.zeros(6), np.zeros((6, 6))
        for k, part in enumerate(parts):
            others = [other.values for j, other in enumerate(parts) if j != k]
            rest = np.prod(others, axis=0) if others else np.ones_like(part.values)
            gradient += rest @ part.by_pose
            curvature += _pull(product, part)
        count = len(product)
        return Quadratic(float(product.mean()), gradient / count, curvature / count)


class IndependentObjective(_SampledObjective):
    """The product of separate objectives: sensors as if they saw different objects."""

    def _combine(self, densities: list[Floats]) -> Floats:
        return np.asarray(np.prod([g.mean(axis=-1) for g in densities], axis=0))

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and mean-shift curvature at one pose (4, 4)."""
        parts = self._linearised(T_world_object)
        means = np.array([part.values.mean() for part in parts])
        gradient, curvature = np.zeros(6), np.zeros((6, 6))
        for k, part in enumerate(parts):
            rest = float(np.prod(np.delete(means, k)))
            gradient += rest * part.by_pose.mean(axis=0)
            curvature += rest * _pull(part.values, part) / len(part.values)
        return Quadratic(float(np.prod(means)), gradient, curvature)


def _pull(weights: Floats, part: _Sampled) -> Floats:
    """Σ_s w_s J_sᵀ J_s / σ²."""
    weighted = part.J * weights[:, None, None]
    size = part.J.shape[-1]
    return np.asarray(weighted.reshape(-1, size).T @ part.J.reshape(-1, size) / part.sigma**2)


def sampled_terms(
    views: Sequence[View],
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats | None = None,
) -> list[SampledTerm]:
    """Densities g_l at given blurs, around the projection of a pose or wherever a sensor sees.

    Parameters
    ----------
    views : sequence of View
    samples : (N, R, 3) array
    sigmas : sequence of float
        Standard deviation of a feature at this level, per view, in sensor units.
    near : (4, 4) array or None
    """
    terms = []
    for view, sigma in zip(views, sigmas, strict=True):
        box = (view.sensor.lower, view.sensor.upper)
        if near is not None:
            y, visible = view.sensor.project(transform(near, samples.reshape(-1, 3)))
            if not visible.any():
                continue
            box = region_of_interest(view.sensor, y[visible], REACH * sigma)
        density = view.observation.density(sigma, box, gradient=True)
        terms.append(SampledTerm(view.sensor, density))
    return terms

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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from mixpose.density import DRAWING, Density
from mixpose.objective.base import View, region_of_interest
from mixpose.objective.index_maps import ParallelMaps
from mixpose.objective.projection import pose_jacobian
from mixpose.optimise import Quadratic
from mixpose.records import Floats, Singles
from mixpose.rigid import transform
from mixpose.sensors import ParallelBeam, Sensor


@dataclass(frozen=True)
class SampledTerm:
    """A sensor with its density g_l (with gradient) at one level of blur."""

    sensor: Sensor
    density: Density


class _SampledObjective:
    """What both objectives share: samples z_ir (N, R, 3) of every feature, and their densities.

    `world_offsets` (R, 3) are displacements in the world that belong to the samples, as by gravity:
    they do not turn with the pose.
    """

    def __init__(
        self,
        terms: Sequence[SampledTerm],
        samples: Floats,
        world_offsets: Floats | None = None,
    ) -> None:
        self.terms = tuple(terms)
        self.points = samples.reshape(-1, 3)
        self._poses_at_once = max(1, DRAWING.held // len(self.points))
        self.offsets: Floats | None = None
        if world_offsets is not None and world_offsets.any():
            self.offsets = np.broadcast_to(world_offsets, samples.shape).reshape(-1, 3)

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        if T_world_object.ndim == 2:
            return self._values(T_world_object[None]).reshape(())
        poses = T_world_object.reshape(-1, 4, 4)
        starts = range(0, len(poses), self._poses_at_once)
        values = [self._values(poses[k : k + self._poses_at_once]) for k in starts]
        return np.concatenate([np.zeros(0), *values]).reshape(T_world_object.shape[:-2])

    def _values(self, poses: Floats) -> Floats:
        """Values (k,) at poses (k, 4, 4)."""
        raise AssertionError("an objective says how sensors combine")

    def _factors(self, densities: Floats) -> list[Floats]:
        """What each sensor's density of a sample is multiplied by, (S,) each, of those (L, S)."""
        raise AssertionError("an objective says how sensors combine")

    @cached_property
    def _alone(self) -> list[Density]:
        """The densities without gradients, which values do not need."""
        first = [np.atleast_3d(term.density.values)[..., 0] for term in self.terms]
        return [
            replace(term.density, values=np.ascontiguousarray(values))
            for term, values in zip(self.terms, first, strict=True)
        ]

    @cached_property
    def _maps(self) -> ParallelMaps | None:
        """Where all sensors are parallel beams."""
        sensors = [one.sensor for one in self.terms if isinstance(one.sensor, ParallelBeam)]
        if len(sensors) < len(self.terms):
            return None
        windows = [term.density.window for term in self.terms]
        return ParallelMaps(sensors, windows, self.points, self.offsets)

    def _densities(self, poses: Floats) -> list[Singles]:
        """g_l of samples, per sensor, in rows of as many for each of the poses (k, 4, 4)."""
        if self._maps is not None:
            return [
                _looked_up(g.values, u, v)
                for g, (u, v) in zip(self._alone, self._maps(poses), strict=True)
            ]
        with np.errstate(all="ignore"):  # poses may be anywhere, even not finite
            points = transform(poses, self.points)
            if self.offsets is not None:
                points += self.offsets
            places = [term.sensor.project(points)[0] for term in self.terms]
            return [g.sample(y) for g, y in zip(self._alone, places, strict=True)]

    def _means(self, blocks: Singles, count: int) -> Floats:
        """Means (k,) over the samples of k poses, summed in double precision."""
        size = len(self.points)
        if count * size == blocks.size == blocks.shape[1]:
            return np.array([cv2.sumElems(blocks)[0] / size])
        by_pose = blocks.reshape(count, -1)[:, :size]
        sums = cv2.reduce(by_pose, 1, cv2.REDUCE_SUM, dtype=cv2.CV_64F)
        return np.asarray(sums[:, 0] / size)

    def linearise(self, poses: Floats) -> Quadratic:
        """Values, gradients and mean-shift curvatures at poses (H, 4, 4)."""
        return Quadratic(*map(np.array, zip(*map(self._model, poses), strict=True)))

    def _model(self, T_world_object: Floats) -> tuple[float, Floats, Floats]:
        """Value, gradient and mean-shift curvature at one pose (4, 4)."""
        points = transform(T_world_object, self.points)
        if self.offsets is not None:
            points += self.offsets
        arms, count = self.points @ T_world_object[:3, :3].T, len(points)
        looked_up, jacobians = [], []
        for term in self.terms:
            y, by_world, _ = term.sensor.linearise(points)
            looked_up.append(term.density.sample(y).astype(np.float64))
            jacobians.append(pose_jacobian(by_world, arms))
        factors = self._factors(np.array([g[:, 0] for g in looked_up]))
        gradient, curvature = np.zeros(6), np.zeros((6, 6))
        for term, g, J, others in zip(self.terms, looked_up, jacobians, factors, strict=True):
            gradient += np.einsum("s,sm,smk->k", others, g[:, 1:], J) / count
            pull = others * g[:, 0] / (count * term.density.sigma**2)
            curvature += (J * pull[:, None, None]).reshape(-1, 6).T @ J.reshape(-1, 6)
        value = float((factors[0] * looked_up[0][:, 0]).mean())
        return value, gradient, curvature


class PaperObjective(_SampledObjective):
    """Formula (4): sensors multiplied inside the integral over the object."""

    def _values(self, poses: Floats) -> Floats:
        product, *others = self._densities(poses)
        for g in others:
            product *= g
        return self._means(product, len(poses))

    def _factors(self, densities: Floats) -> list[Floats]:
        return [np.prod(np.delete(densities, k, axis=0), axis=0) for k in range(len(densities))]


class IndependentObjective(_SampledObjective):
    """The product of separate objectives: sensors as if they saw different objects."""

    def _values(self, poses: Floats) -> Floats:
        means = [self._means(g, len(poses)) for g in self._densities(poses)]
        return np.asarray(np.prod(means, axis=0))

    def _factors(self, densities: Floats) -> list[Floats]:
        means = densities.mean(axis=1)
        ones = np.ones(densities.shape[1])
        return [np.prod(np.delete(means, k)) * ones for k in range(len(means))]


def _looked_up(g: Singles, u: Singles, v: Singles) -> Any:
    return cv2.remap(g, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def sampled_terms(
    views: Sequence[View],
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats | None = None,
) -> list[SampledTerm]:
    """Densities g_l around the samples (N, R, 3) at a pose (4, 4), or wherever a sensor sees.

    `sigmas` are the standard deviations of a feature at this level, per view, in sensor units.
    """
    terms = []
    for view, sigma in zip(views, sigmas, strict=True):
        box = (view.sensor.lower, view.sensor.upper)
        if near is not None:
            y, visible = view.sensor.project(transform(near, samples.reshape(-1, 3)))
            if not visible.any():
                continue
            box = region_of_interest(view.sensor, y[visible], DRAWING.paper_reach * sigma)
        density = view.observation.density(sigma, box, gradient=True)
        terms.append(SampledTerm(view.sensor, density))
    return terms

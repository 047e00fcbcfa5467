"""The paper's objectives by sampling, formula (4) and the product it warns of; objectives by name.

Densities are looked up with `cv2.remap`, batched over poses; that of a feature which a sensor
cannot see is 0.  Curvatures are those of mean-shift: every sample pulls with the weight of its
density, as if its feature were a Gaussian of the level's σ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias, get_args

import cv2
import numpy as np

from mixpose.body import Body
from mixpose.density import DRAWING, Density, remap
from mixpose.objective.matched import MatchedObjective, matched_objective
from mixpose.objective.projection import View, pose_jacobian
from mixpose.optimise import Quadratic
from mixpose.records import Floats, Singles, replace
from mixpose.rigid import transform
from mixpose.sensors import AffineSensor, Sensor

ObjectiveName: TypeAlias = Literal["matched", "paper", "independent"]
OBJECTIVES: tuple[ObjectiveName, ...] = get_args(ObjectiveName)


@dataclass(frozen=True)
class SampledTerm:
    """A sensor with its density g_l, with gradient, at one level of blur."""

    sensor: Sensor
    density: Density


class PaperObjective:
    """Formula (4), (1/NR) Σ_i Σ_r Π_l g_l(p(z_ir; β, γ_l)): all sensors see the same Z.

    The samples z_ir (N, R, 3) are displaced in the world by offsets (R, 3), as by gravity.
    """

    def __init__(
        self, terms: Sequence[SampledTerm], samples: Floats, world_offsets: Floats | None = None
    ) -> None:
        self.terms = tuple(terms)
        self.points = samples.reshape(-1, 3)
        offsets = np.zeros(3) if world_offsets is None else world_offsets
        self.offsets = np.broadcast_to(offsets, samples.shape).reshape(-1, 3)

    def value(self, T_world_object: Floats) -> Floats:
        """Return values (...,) at poses (..., 4, 4)."""
        if T_world_object.ndim == 2:  # the fast path
            return self._values(T_world_object[None]).reshape(())
        poses, at_once = T_world_object.reshape(-1, 4, 4), max(1, DRAWING.held // len(self.points))
        values = [self._values(poses[k : k + at_once]) for k in range(0, len(poses), at_once)]
        return np.concatenate(values or [np.zeros(0)]).reshape(T_world_object.shape[:-2])

    def linearise(self, poses: Floats) -> Quadratic:
        """Return values, gradients and mean-shift curvatures at poses (H, 4, 4)."""
        return Quadratic(*map(np.array, zip(*map(self._model, poses), strict=True)))

    def _model(self, T_world_object: Floats) -> tuple[float, Floats, Floats]:
        """Return value, gradient and mean-shift curvature at one pose (4, 4)."""
        if not self.terms:  # no sensor has the body in view
            return 0.0, np.zeros(6), np.zeros((6, 6))
        points = transform(T_world_object, self.points) + self.offsets
        arms, count = self.points @ T_world_object[:3, :3].T, len(points)
        projected = [(term.density, *term.sensor.linearise(points)) for term in self.terms]
        drawn = [density.sample(y).astype(np.float64) for density, y, _, _ in projected]
        parts = self._parts([g[None, :, 0] for g in drawn])
        gradient, curvature = np.zeros(6), np.zeros((6, 6))
        for k, ((density, _, by_world, _), g) in enumerate(zip(projected, drawn, strict=True)):
            J = pose_jacobian(by_world, arms)
            other_factors = (part[0] for j, part in enumerate(parts) if j != k)
            product = math.prod(other_factors, start=np.ones(count))
            gradient += np.einsum("s,sm,smk->k", product, g[:, 1:], J) / count
            pull = product * g[:, 0] / (count * density.sigma**2)
            curvature += (J * pull[:, None, None]).reshape(-1, 6).T @ J.reshape(-1, 6)
        return float((product * g[:, 0]).mean()), gradient, curvature

    def _parts(self, densities: Sequence[Floats | Singles]) -> Sequence[Floats | Singles]:
        """Return the factors of all sensors, (k, S) or (k, 1) each, from densities (k, S)."""
        return densities

    def _values(self, poses: Floats) -> Floats:
        """Return values (k,) at poses (k, 4, 4)."""
        if not self.terms:
            return np.zeros(len(poses))
        product, *factors = self._parts(self._densities(poses))
        for part in factors:
            product *= part
        return _means(product)

    def _densities(self, poses: Floats) -> list[Singles]:
        """Look up g_l of samples (k, S), per sensor, at poses (k, 4, 4)."""
        if self._maps is not None:
            maps = self._maps.at(poses).swapaxes(0, 1)
            return [remap(g.values, *maps[2 * k : 2 * k + 2]) for k, g in enumerate(self._plain)]
        with np.errstate(all="ignore"):  # poses may be anywhere, even not finite
            points = transform(poses, self.points) + self.offsets
            return [
                g.sample(term.sensor.project(points)[0])
                for term, g in zip(self.terms, self._plain, strict=True)
            ]

    @cached_property
    def _plain(self) -> list[Density]:
        """Densities without gradients."""
        return [
            replace(density, values=np.ascontiguousarray(np.atleast_3d(density.values)[..., 0]))
            for density in (term.density for term in self.terms)
        ]

    @cached_property
    def _maps(self) -> _AffineMaps | None:
        """Fast maps if no sensor has perspective, else None."""
        is_affine = all(isinstance(term.sensor, AffineSensor) for term in self.terms)
        return _AffineMaps(self.terms, self.points, self.offsets) if is_affine else None


class IndependentObjective(PaperObjective):
    """Π_l (1/NR) Σ_i Σ_r g_l(p(z_ir; β, γ_l)): as if sensors saw different objects."""

    def _parts(self, densities: Sequence[Floats | Singles]) -> Sequence[Floats | Singles]:
        return [_means(g)[:, None] for g in densities]


def _means(g: Floats | Singles) -> Floats:
    """Return means (k,) over the samples (k, S) of k poses, summed in double precision."""
    if len(g) == 1:  # in a third of the time
        return np.array([cv2.sumElems(g)[0] / g.size])
    return np.asarray(cv2.reduce(g, 1, cv2.REDUCE_SUM, dtype=cv2.CV_64F).ravel() / g.shape[1])


class _AffineMaps:
    """Places of a body's samples (S, 3) in the arrays of densities, for `cv2.remap`.

    An evaluation of a sampled objective should cost hardly more than its look-ups.  So if no sensor
    has perspective, samples are kept in single precision, and one matrix product gives the array
    indices of all: they err by less than 1/1000 in arrays of up to 4000 a side, as samples are
    relative to their centre.
    """

    def __init__(self, terms: Sequence[SampledTerm], points: Floats, offsets: Floats) -> None:
        to_centre = np.eye(4)
        to_centre[:3, 3] = centre = (points.min(axis=0) + points.max(axis=0)) / 2
        parts = [points - centre, np.ones((len(points), 1))]
        rows, limits = [], []
        for term in terms:
            assert isinstance(term.sensor, AffineSensor)
            origin, step = term.density.window.origin, term.density.window.step
            rows.append(term.sensor.affine / step)
            rows[-1][:, 3] -= origin / step
            limits.append((np.stack([term.sensor.lower, term.sensor.upper]) - origin) / step)
        P = np.concatenate(rows)  # (2 L, 4) array indices of points in the world
        # coefficients (16, 2 L c) of indices by the 16 numbers of a pose, the last of which is 1
        by_pose = np.einsum("ia,bj->abij", P, to_centre)
        middle = by_pose[..., 3].reshape(16, -1).copy()
        if offsets.any():
            parts.append(offsets)
            by_pose = np.pad(by_pose, [(0, 0), (0, 0), (0, 0), (0, 3)])
            by_pose[3, 3, :, 4:] = P[:, :3]
        self._samples: Singles = np.ascontiguousarray(np.hstack(parts).T, dtype=np.float32)
        lower, upper = np.clip(np.concatenate(limits, axis=1), DRAWING.far, -DRAWING.far)
        self._limits = [limit[:, None].astype(np.float32) for limit in (lower, upper)]
        # numbers that are within ±1 if the centre lies so that all samples are in view
        reach = sum(float(np.linalg.norm(x, axis=1).max()) for x in (parts[0], offsets))
        half = (upper - lower) / 2 - reach * np.linalg.norm(P[:, :3], axis=1)
        middle[15] -= (lower + upper) / 2
        self._width = by_pose[0, 0].size
        is_seen = middle / np.where(half > 0, half, np.nan)
        self._by_pose = np.hstack([by_pose.reshape(16, -1), is_seen])

    def at(self, poses: Floats) -> Singles:
        """Return indices (k, 2 L, S) along columns and rows, sensor by sensor, at poses (k, 4, 4).

        They are `DRAWING.far`, outside any array, for samples that are not seen or not finite.
        """
        rows, (c, count) = poses.reshape(-1, 16).dot(self._by_pose), self._samples.shape
        with np.errstate(all="ignore"):  # poses may be anywhere, even not finite
            single = rows[:, : self._width].astype(np.float32).reshape(-1, c)
            maps = np.asarray(single.dot(self._samples).reshape(len(rows), -1, count))
            if not cv2.checkRange(rows[:, self._width :], True, -1.0, 1.0)[0]:
                lower, upper = self._limits
                maps[~((maps >= lower) & (maps <= upper))] = DRAWING.far
        return maps


def region_of_interest(sensor: Sensor, y: Floats, margin: float) -> tuple[Floats, Floats]:
    """Return the box (lower, upper) around visible points (n, m), with a margin, in the sensor."""
    lower, upper = y.min(axis=0) - margin, y.max(axis=0) + margin
    return np.maximum(lower, sensor.lower), np.minimum(upper, sensor.upper)


def sampled_terms(
    views: Sequence[View], samples: Floats, sigmas: Sequence[float], near: Floats
) -> list[SampledTerm]:
    """Draw densities g_l around samples (N, R, 3) at a pose (4, 4), of sensors that see any.

    `sigmas` are the standard deviations of a feature at this level, per view, in sensor units.
    """
    terms = []
    for view, sigma in zip(views, sigmas, strict=True):
        y, visible = view.sensor.project(transform(near, samples.reshape(-1, 3)))
        if visible.any():
            box = region_of_interest(view.sensor, y[visible], DRAWING.paper_reach * sigma)
            terms.append(
                SampledTerm(view.sensor, view.observation.density(sigma, box, gradient=True))
            )
    return terms


def build_objective(
    name: ObjectiveName,
    views: Sequence[View],  # whose observation is not empty
    body: Body,
    samples: Floats,  # (N, R, 3) of the body; the matched objective does not use them
    sigmas: Sequence[float],  # of a feature at this level, per view, in sensor units
    near: Floats,  # (4, 4) pose around whose projection densities are drawn
    seed: int = 0,  # of the samples
) -> MatchedObjective | PaperObjective:
    """Build an objective of the pose at one level of blur."""
    if name == "matched":
        return matched_objective(views, body, sigmas)
    kind = PaperObjective if name == "paper" else IndependentObjective
    terms = sampled_terms(views, samples, sigmas, near)
    return kind(terms, samples, body.world_offsets(samples.shape[1], seed=seed))

"""What an estimate is worth: per-sensor reports, covariance and status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import peak
from mixpose.objective import View, pose_jacobian
from mixpose.objective.base import facing
from mixpose.objective.matched import MatchedTerm, matched_objective, overlap_terms
from mixpose.records import SensorReport
from mixpose.rigid import transform

Floats: TypeAlias = NDArray[np.float64]

LEAST_COVERAGE = 0.5
"""Share of the body's visible features that must be met, on average over the sensors."""

_LEAST_SHARE = 0.3  # of a full feature's density: below it a feature was not met
_LEAST_NOISE = 1e-3  # of σ_ε: float32 densities do not resolve residuals below


@dataclass(frozen=True)
class Assessment:
    """How well a pose explains the frame.

    Attributes
    ----------
    sensors : dict of str to SensorReport
    score : float
        Mean cosine between predicted and observed densities, 0 to 1.
    coverage : float
        Mean share of the body's features that are met.
    found : float
        Number of met features, summed over sensors.
    measurements : float
        Number of met sensor coordinates.
    covariance : (6, 6) float64
        Zero in directions that are not estimated.
    """

    sensors: dict[str, SensorReport]
    score: float
    coverage: float
    found: float
    measurements: float
    covariance: Floats


@dataclass(frozen=True)
class _Met:
    """Features of the body that one sensor met."""

    report: SensorReport
    cosine: float
    coverage: float
    shares: Floats
    offsets: Floats
    J: Floats
    sigma: float


def assess(
    views: Sequence[View], body: Body, T_world_object: Floats, free: NDArray[np.bool_]
) -> Assessment:
    """Judge a pose by the matched densities at the finest blur.

    Parameters
    ----------
    views : sequence of View
    body : Body
    T_world_object : (4, 4) array
    free : (6,) bool
        Directions that were estimated.
    """
    sigmas = [view.observation.sigma for view in views]
    objective = matched_objective(views, body, sigmas, T_world_object, fine=True)
    met = {term.name: _meet(term, body, T_world_object) for term in objective.terms}
    reports = {}
    for view in views:
        one = met.get(view.name)
        reports[view.name] = one.report if one else SensorReport(True, 0.0, None)
    everything = [one for one in met.values() if one is not None]
    count = max(len(views), 1)
    return Assessment(
        sensors=reports,
        score=sum(one.cosine for one in everything) / count,
        coverage=sum(one.coverage for one in everything) / count,
        found=sum(float(one.shares.sum()) for one in everything),
        measurements=sum(float(one.shares.sum()) * one.J.shape[1] for one in everything),
        covariance=_covariance(everything, free),
    )


def _meet(term: MatchedTerm, body: Body, T_world_object: Floats) -> _Met | None:
    points, weights = body.nodes.points, body.nodes.weights
    points_world = transform(T_world_object, points)
    y, by_world, seen = term.sensor.linearise(points_world)
    seen &= facing(term.sensor, T_world_object, points_world, body.node_normals)
    if not seen.any():
        return None
    J = pose_jacobian(by_world[seen], T_world_object, points[seen])
    weights = weights[seen]
    sampled = term.matched.sample(y)[seen].astype(np.float64)
    norm = overlap_terms(y[seen], J, weights, term.variance).norm
    product = float(weights @ sampled[:, 0])
    if product <= 0:
        return None
    explained = product**2 / (term.energy * norm)
    shares, offsets = _residuals(term, y[seen], weights, sampled, amplitude=product / norm)
    if not shares.any():
        return None
    squared = float(shares @ (offsets**2).sum(axis=1)) / float(shares.sum())
    count = peak(term.variance, y.shape[1]) / term.energy
    return _Met(
        report=SensorReport(True, min(explained, 1.0), float(np.sqrt(squared))),
        cosine=float(np.sqrt(min(explained, 1.0))),
        coverage=float(np.sqrt(min(explained * count / weights.sum(), 1.0))),
        shares=shares,
        offsets=offsets,
        J=J,
        sigma=float(np.sqrt(term.variance / 2)),
    )


def _residuals(
    term: MatchedTerm, y: Floats, weights: Floats, sampled: Floats, amplitude: float
) -> tuple[Floats, Floats]:
    """How far the observation puts each feature from its prediction.

    Around a prediction that fits, C is `amplitude` times the predicted mixture blurred alike.
    What is left of the gradient is the pull on this feature alone, without its neighbours'.

    Returns
    -------
    shares : (n,) array
        Weight with which each feature was met; 0 for those that were not.
    offsets : (n, m) array
        Residuals in sensor units.
    """
    top = peak(term.variance, y.shape[1])
    away = y[:, None] - y[None]
    bells = weights * np.exp(-0.5 * (away * away).sum(axis=-1) / term.variance) * top
    predicted_gradient = -(bells[..., None] * away).sum(axis=1) / term.variance
    neighbours = bells.sum(axis=1) - weights * top
    own = sampled[:, 0] - amplitude * neighbours
    # what the better half of the features looks like on its own
    full = float(np.median(np.sort(own)[len(own) // 2 :]))
    if full <= 0:
        return np.zeros(len(y)), np.zeros(y.shape)
    shares = np.clip(own / full, 0.0, 1.0)
    shares = np.where(shares > _LEAST_SHARE, shares, 0.0) * weights
    pull = sampled[:, 1:] - amplitude * predicted_gradient
    offsets = term.variance * pull / np.maximum(own, _LEAST_SHARE * full)[:, None]
    return shares, np.where(shares[:, None] > 0, offsets, 0.0)


def _covariance(met: list[_Met], free: NDArray[np.bool_]) -> Floats:
    """Inverse information of the met features, with the noise that their residuals show."""
    information = np.zeros((6, 6))
    measurements = sum(float(one.shares.sum()) * one.J.shape[1] for one in met)
    degrees = max(measurements - int(free.sum()), 1.0)
    for one in met:
        own = float(one.shares.sum()) * one.J.shape[1]
        noise = float(one.shares @ (one.offsets**2).sum(axis=1)) / max(own, 1e-9)
        noise = max(noise * measurements / degrees, (_LEAST_NOISE * one.sigma) ** 2)
        weighted = one.J * one.shares[:, None, None]
        information += weighted.reshape(-1, 6).T @ one.J.reshape(-1, 6) / noise
    covariance = np.zeros((6, 6))
    inverse = np.linalg.pinv(information[np.ix_(free, free)], hermitian=True)
    covariance[np.ix_(free, free)] = (inverse + inverse.T) / 2
    return covariance

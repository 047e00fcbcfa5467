"""Rivals of one judged pose: without a sensor, with merged features, at narrow blurs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.special import fdtri

from mixpose.judgement import AcceptanceRules, NoiseModel, ScoredPose
from mixpose.matching import LEAST_VARIANCE, Matches, pooled
from mixpose.rigid import perturb
from mixpose.tracking.frame import Frame
from mixpose.tracking.in_motion import gauss_newton
from mixpose.tracking.likelihood import Likelihood, Start

OUT_OF_STEP = "out of step or bumped"


class Refinement(Protocol):
    """Starts that may do better than one judged pose."""

    __name__: str

    def __call__(self, frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
        """Where fits may begin; nothing where the pose leaves nothing to mend."""


def without_sensor(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """The pose fitted without the sensors that disagree with two others or more."""
    if not likelihood.knows_detections or len(frame.views) < 3 or judged.left_out:
        return
    rules = frame.rules
    if apart := disagreeing(judged.matches, rules.acceptance, rules.judgement.noise):
        yield Start(judged.T_world_object, frame.close, left_out=dict.fromkeys(apart, OUT_OF_STEP))


def disagreeing(seen: Matches, rules: AcceptanceRules, model: NoiseModel) -> list[str]:
    """Sensors that see the body elsewhere than two others or more do.

    One that meets little of it, with as many detections beside it that belong to nothing; or one
    whose residuals are far larger than the others', more than chance would make them.
    """
    agreeing = seen.coverage >= rules.agreeing
    apart = ~agreeing & (seen.expected > 0)
    apart &= seen.unmatched_nearby >= rules.agreeing * seen.missed
    squares, degrees = seen.squares * agreeing, seen.measurements * agreeing
    for k in np.flatnonzero(agreeing & (degrees > 0)):
        rest, own = float(degrees.sum() - degrees[k]), float(degrees[k])
        if np.count_nonzero(agreeing) < 3 or rest == 0:
            continue
        variance = float(squares.sum() - squares[k]) / rest
        limit = max(rules.disagreeing, float(fdtri(own, rest, model.by_chance)))
        apart[k] = squares[k] / own > limit * max(variance, LEAST_VARIANCE)
    names = [seen.names[k] for k in np.flatnonzero(apart)]
    return names if np.count_nonzero(agreeing & ~apart) >= 2 else []


def merged_pair(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Least squares with the middle of two features that run into each other in one detection."""
    if not likelihood.knows_detections:
        return []
    at, seen = judged, _paired(judged.matches, frame.rules.judgement.association.reach_squared)
    for _ in range(2):  # the second step starts within 0.01 σ_ε of the first's end
        if not seen.merged.any():
            break
        J, offsets = seen.rows()
        step = gauss_newton(J.reshape(-1, 6), offsets.ravel(), frame.free)
        start = Start(perturb(at.T_world_object, step))
        at = likelihood.judge(likelihood.fit(start), start)
        seen = at.matches
    return [] if at is judged else [Start(at.T_world_object)]


def _paired(seen: Matches, reach: float) -> Matches:
    """Two features in one: in each sensor the one not met nearest to the detection of another.

    `reach` is how far that may be, squared, in variances of C.
    """
    if not seen.missed.any():
        return seen
    shares, offsets, J = seen.shares.copy(), seen.offsets.copy(), seen.J.copy()
    merged = seen.merged.copy()
    for k in np.flatnonzero((seen.merged == 0) & (seen.missed > 0) & (seen.met > 0)):
        met = np.flatnonzero(seen.detections[k] >= 0)
        lost = np.flatnonzero((seen.weights[k] > 0) & (shares[k] == 0))
        if not len(met) or not len(lost):
            continue
        apart = (seen.places[k, met] - seen.places[k, lost, None]) / seen.sigmas[k]
        away = apart + offsets[k, met]
        squared = (away * away).sum(axis=2) / 2
        i, j = np.unravel_index(int(squared.argmin()), squared.shape)
        if squared[i, j] > reach:
            continue
        pair = [lost[i], met[j]]
        shares[k, pair] = shares[k, met[j]] / 2
        offsets[k, pair] = (away[i, j] + offsets[k, met[j]]) / 2
        J[k, pair] = J[k, pair].mean(axis=0)
        merged[k] = 1
    return replace(seen, shares=shares, offsets=offsets, J=J, merged=merged)


def narrowed(frame: Frame, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """The predictions at narrow blurs, where residuals are larger than chance makes them.

    Spots that are cut are off by less than a fit's first blur leaves out; narrow ones do.
    """
    if not judged.is_unlike or not likelihood.knows_detections:
        return
    if any(view.observation.cell is not None for view in frame.views):
        return
    errors = frame.rules.judgement.noise.errors
    variances = pooled(frame.noise, errors, errors.typical_degrees)
    largest = errors.outlying**2 * variances[:, None]
    narrowest = errors.blur * float(np.sqrt(variances.max()))
    for one in frame.predictions:
        for blur in [blur for blur in frame.rules.proposals.blurs if blur > narrowest]:
            start = Start(one.T_world_object, one.uncertainty, blur=blur)
            found = likelihood.judge(likelihood.fit(start), start)
            met = found.matches.shares > 0
            off = np.count_nonzero(met & (found.matches.squared > largest), axis=1)
            # where all of a sensor are off it is out of step, and the others no better for it
            if not (off > np.count_nonzero(met, axis=1) / 2).any():
                yield Start(found.T_world_object)


REFINEMENTS: tuple[Refinement, ...] = (without_sensor, merged_pair, narrowed)

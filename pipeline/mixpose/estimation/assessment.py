"""What an estimate is worth: per-sensor reports, covariance and evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.estimation.evidence import (
    Noise,
    Prior,
    covariance_of,
    flat_prior,
    information_of,
    log_evidence,
    noise_of,
)
from mixpose.estimation.meeting import Meeting, meet
from mixpose.objective import Gaze, View
from mixpose.objective.matched import matched_objective
from mixpose.records import SensorReport

Floats: TypeAlias = NDArray[np.float64]

MEMORY = 0.95  # per frame, of the residuals before
FORGETTING = 0.8  # the same where they no longer seem to hold


@dataclass(frozen=True)
class Assessment:
    """How well a pose explains the frame.

    Attributes
    ----------
    sensors : dict of str to SensorReport
    score : float
        Mean cosine between predicted and observed densities, 0 to 1.
    coverage : float
        Mean share of the body's features in view that are met.
    measurements : float
        Number of met sensor coordinates.
    covariance : (6, 6) float64
        Zero in directions that are not estimated.
    log_evidence : float
        Logarithm of the odds for this pose against mere clutter.
    noise : Noise
        Residuals of this frame and, fading, of those before it, for the next frame.
    meetings : tuple of Meeting
        The pose against each sensor that has some of the body in view.
    """

    sensors: dict[str, SensorReport]
    score: float
    coverage: float
    measurements: float
    covariance: Floats
    log_evidence: float
    noise: Noise
    meetings: tuple[Meeting, ...] = ()


def assess(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    free: NDArray[np.bool_],
    *,
    before: Noise | None = None,
    prior: Prior | None = None,
    gazes: Sequence[Gaze] = (),
) -> Assessment:
    """Judge a pose by the matched densities at the finest blur.

    Parameters
    ----------
    views : sequence of View
    body : Body
    T_world_object : (4, 4) array
    free : (6,) bool
        Directions that were estimated.
    before : Noise or None
        Residuals of the frames before.
    prior : Prior or None
        What was known of the pose; None: nothing.
    gazes : sequence of Gaze
        Of the views' sensors at the body, where they are at hand.
    """
    sigmas = [view.observation.sigma for view in views]
    objective = matched_objective(views, body, sigmas, T_world_object, fine=True, gazes=gazes)
    observations = {view.name: view.observation for view in views}
    met: dict[str, Meeting] = {}
    for stack in objective.stacks:
        names = [term.name for term in stack.terms]
        seen = meet(stack, [observations[name] for name in names], T_world_object)
        met |= dict(zip(names, seen, strict=True))
    reports = {
        view.name: SensorReport(True, met[view.name].explained, met[view.name].rms)
        if view.name in met
        else SensorReport(True, 0.0, None)
        for view in views
    }
    meetings = list(met.values())
    count = max(len(views), 1)
    blind = float(len(body) * (len(views) - len(meetings)))
    information = information_of(meetings)
    noise, remembered = _noises(before or Noise(), noise_of(meetings, free))
    return Assessment(
        sensors=reports,
        score=sum(math.sqrt(one.explained) for one in meetings) / count,
        coverage=sum(one.coverage for one in meetings) / count,
        measurements=sum(one.measurements for one in meetings),
        covariance=covariance_of(information, noise, free),
        log_evidence=log_evidence(
            meetings, information, noise, free, prior or flat_prior(body, free), blind
        ),
        noise=remembered,
        meetings=tuple(meetings),
    )


def _noises(before: Noise, own: Noise) -> tuple[Noise, Noise]:
    """The noise that a frame's covariance goes by, and the one that is remembered.

    As a rule both are that of the frames so far.  A frame with residuals of another kind, as where
    two features run into each other, goes by its own, and the frames after it forget it.
    """
    if before.is_outdone_by(own):
        return own, Noise(FORGETTING * before.squares, FORGETTING * before.degrees)
    joined = before.joined(own, MEMORY)
    return joined, joined

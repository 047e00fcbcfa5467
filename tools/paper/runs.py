"""One run of the accuracy evaluation: every estimator on every system and scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions, fit_near
from mixpose.objective import View, matched_objective
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import GridPattern
from mixpose.rigid import perturb
from paper.bounds import cramer_rao, oracle
from paper.measurements import Measurement, measure
from paper.sampled import sampled_objectives
from paper.search import fmaxsearch
from paper.systems import SCENARIOS, Scenario, System, draw, parameters, pose, systems

Floats: TypeAlias = NDArray[np.float64]
Cell: TypeAlias = tuple[str, str]
Errors: TypeAlias = dict[Cell, dict[str, Floats]]

SAMPLES = 1000

INDEPENDENT_EVERY = 3
"""The product of separate objectives, only there to compare, is estimated in every third run."""

# Standard deviations of the starts: uniform within ±5 units and ±2.5°.  In world axes w turns with
# the body, and a turn moves the origin, which is w away from the centre of turning.
START_UNCERTAINTY = np.array([3.4] * 3 + [np.radians(2.5) / np.sqrt(3)] * 3)

DEGREES = np.array([180 / np.pi] * 3 + [1.0] * 3)


def run(seed: int, number: int) -> Errors:
    """Errors (6,) in degrees and units of run `number`, by system and scenario, by estimator.

    "crlb" and "crlb_prior" hold variances instead.
    """
    cv2.setNumThreads(1)
    truth, start = draw(np.random.default_rng([seed, number]))
    errors: Errors = {}
    for i, system in enumerate(systems()):
        for j, scenario in enumerate(SCENARIOS):
            noise = np.random.default_rng([seed, number, i, j])
            measurements = measure(system, scenario, truth, noise)
            sampling_seed = int(noise.integers(2**31))
            cell = _paper(
                system,
                scenario,
                measurements,
                start,
                sampling_seed,
                compare=number % INDEPENDENT_EVERY == 0,
            )
            cell |= _matched(system, scenario, measurements, truth, start)
            body = system.body(scenario)
            cell["oracle"] = oracle(system, scenario, body, truth)
            cell = {name: (beta - truth) * DEGREES for name, beta in cell.items()}
            if scenario.noisy:
                bounds = cramer_rao(system, scenario, measurements, truth)
                cell["starts"] = (start - truth) * DEGREES
                cell["crlb"], cell["crlb_prior"] = (one * DEGREES**2 for one in bounds)
            errors[system.name, scenario.name] = cell
    return errors


def _paper(
    system: System,
    scenario: Scenario,
    measurements: Sequence[Measurement],
    start: Floats,
    sampling_seed: int,
    *,
    compare: bool,
) -> dict[str, Floats]:
    """The paper's objective, and on demand the product it warns of, by Nelder-Mead."""
    body = system.body(scenario)
    samples = body.sample(SAMPLES, antithetic=False, common=True, seed=sampling_seed)
    paper, independent = sampled_objectives(system, measurements, samples)
    found = {"paper": fmaxsearch(paper, start)}
    if compare:
        found["independent"] = fmaxsearch(independent, start)
    return found


def _matched(
    system: System,
    scenario: Scenario,
    measurements: Sequence[Measurement],
    truth: Floats,
    start: Floats,
) -> dict[str, Floats]:
    """The matched estimate from the start; under noise also the likeliest pose near the truth."""
    body = system.body(scenario)
    seen = views(system, scenario, measurements)
    fit = fit_near(
        seen, body, pose(start), START_UNCERTAINTY, EstimatorOptions(), body.means[:, None]
    )
    found = {"matched": parameters(fit.T_world_object)}
    if scenario.noisy:
        found["ml-from-truth"] = parameters(likeliest_near(seen, body, pose(truth)))
    return found


def likeliest_near(seen: Sequence[View], body: Body, T_truth: Floats) -> Floats:
    """The maximum of the likelihood that is reached from the true pose: a yardstick only."""
    sigmas = [view.observation.sigma for view in seen]
    likelihood = matched_objective(seen, body, sigmas)
    options = NewtonOptions(iterations=60, tolerance=1e-11, value_error=1e-4)
    free = np.ones(6, dtype=np.bool_)
    return np.asarray(ascend(likelihood, T_truth[None], perturb, free, options).states[0])


def views(system: System, scenario: Scenario, measurements: Sequence[Measurement]) -> list[View]:
    """Measurements as observations whose features have the width σ_ε already."""
    seen = []
    for k, (sensor, one) in enumerate(zip(system.sensors, measurements, strict=True)):
        pattern = GridPattern(one.values, one.origin, 1.0)
        observation = Observation(pattern, scenario.sigma, intrinsic=scenario.sigma)
        seen.append(View(f"sensor {k + 1}", sensor, observation))
    return seen

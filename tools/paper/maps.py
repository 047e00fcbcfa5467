"""Objective maps over the 2-D motion (φ, w) of the paper's section on visualisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.objective import matched_objective
from paper.measurements import Measurement, measure
from paper.runs import views
from paper.sampled import sampled_objectives
from paper.systems import SCENARIOS, Scenario, System, pose, systems

Floats: TypeAlias = NDArray[np.float64]

TRUTH = (np.pi / 3, 40.0)
SPREAD = 10.0
SAMPLES = {"1": 1, "2": 240, "3": 120}
"""R of the maps."""

PHI = np.linspace(0.0, 2 * np.pi / 3, 97)
W = np.linspace(0.0, 80.0, 97)


def mapped_scenarios() -> tuple[Scenario, ...]:
    """The four scenarios of the figures; in III the model is not told."""
    return tuple(s for s in SCENARIOS if not s.model_deformed)


def parameters_of_motion(phi: float, w: float) -> Floats:
    """The six numbers of p1(z; (φ, w)): turned by −φ about z3, shifted along the diagonal."""
    return np.array([0.0, 0.0, -phi, w, w, w])


def mapped_systems() -> tuple[System, ...]:
    """Systems 1 to 3 with the wider features of the maps."""
    return systems(SPREAD)


def measured(system: System, scenario: Scenario, seed: int) -> list[Measurement]:
    """The signals of a map; systems 1 and 2 see the same ones."""
    ranging = int(system.name == "3")
    names = [s.name for s in SCENARIOS]
    rng = np.random.default_rng([seed, ranging, names.index(scenario.name)])
    return measure(system, scenario, parameters_of_motion(*TRUTH), rng)


def paper_map(system: System, scenario: Scenario, seed: int) -> Floats:
    """Formula (4) over w (rows) and φ (columns)."""
    count = SAMPLES[system.name]
    body = system.body(scenario)
    samples = body.sample(max(count, 2), antithetic=False, common=True, seed=seed)
    paper, _ = sampled_objectives(system, measured(system, scenario, seed), samples)
    return np.array([[paper(parameters_of_motion(phi, w)) for phi in PHI] for w in W])


def matched_map(system: System, scenario: Scenario, seed: int) -> Floats:
    """The matched objective over w (rows) and φ (columns)."""
    seen = views(system, scenario, measured(system, scenario, seed))
    body = system.body(scenario)
    objective = matched_objective(seen, body, [scenario.sigma] * len(seen))
    objective = replace(objective, weights=np.ones_like(objective.weights))
    poses = np.array([[pose(parameters_of_motion(phi, w)) for phi in PHI] for w in W])
    return np.stack([objective.value(row) for row in poses])


def peak_of(values: Floats) -> tuple[float, float]:
    """(φ, w) of the largest value of a map."""
    row, column = np.unravel_index(int(np.argmax(values)), values.shape)
    return float(PHI[column]), float(W[row])


def image_box(measurements: Sequence[Measurement]) -> tuple[int, int, int, int]:
    """Columns and rows (u0, u1, v0, v1) that hold the features of all images."""
    clean = np.array([m.clean for m in measurements]).sum(axis=0)
    bright = clean > 0.01 * clean.max()
    columns, rows = np.flatnonzero(bright.any(axis=0)), np.flatnonzero(bright.any(axis=1))
    return int(columns[0]), int(columns[-1]), int(rows[0]), int(rows[-1])

"""Scenario III at other strengths: what the matched estimate makes of a body it does not know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from mixpose.fit import EstimatorOptions, Fit, fit_near
from paper.bounds import oracle
from paper.measurements import measure
from paper.runs import DEGREES, START_UNCERTAINTY, views
from paper.systems import SCENARIOS, System, draw, parameters, pose, systems
from paper.table import NUMBERS

Floats: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = dict[str, dict[str, dict[str, Any]]]


def deformed_run(
    system: System, times: float, seed: int, number: int
) -> tuple[Fit, Floats, Floats]:
    """The matched fit, its errors (6,), and those with known correspondences: degrees, units."""
    scenario = replace(next(one for one in SCENARIOS if one.name == "III"), times=times)
    truth, start = draw(np.random.default_rng([seed, number]))
    body = system.body(scenario)
    seen = views(system, scenario, measure(system, scenario, truth, np.random.default_rng(0)))
    fit = fit_near(
        seen, body, pose(start), START_UNCERTAINTY, EstimatorOptions(), body.means[:, None]
    )
    found, known = parameters(fit.T_world_object), oracle(system, scenario, body, truth)
    return fit, (found - truth) * DEGREES, (known - truth) * DEGREES


def deformation_rows(strengths: Sequence[float], runs: int, seed: int) -> Rows:
    """RMS errors by strength and system, and in how many runs features were freed."""
    rows: Rows = {}
    for times in strengths:
        rows[f"{times:g}"] = {}
        for system in systems():
            results = [deformed_run(system, times, seed, number) for number in range(runs)]
            rows[f"{times:g}"][system.name] = {
                "matched": _rms([error for _, error, _ in results]),
                "oracle": _rms([known for _, _, known in results]),
                "freed": sum(fit.freed for fit, _, _ in results),
            }
    return rows


def show_deformation(rows: Rows, runs: int, console: Console) -> None:
    """Print the rows."""
    shown = Table(title=f"Scenario III, times the deformation, {runs} runs", title_justify="left")
    for heading in ("times", "system", "freed in", "estimate"):
        shown.add_column(heading)
    for heading in NUMBERS:
        shown.add_column(heading, justify="right")
    for times, by_system in rows.items():
        for system, row in by_system.items():
            for name in ("matched", "oracle"):
                values = (f"{x:.4g}" for x in row[name])
                shown.add_row(times, system, str(row["freed"]), name, *values)
    console.print(shown)


def _rms(errors: Sequence[Floats]) -> list[float]:
    return [float(x) for x in np.sqrt((np.array(errors) ** 2).mean(axis=0))]

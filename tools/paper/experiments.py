"""Where printed rows come from that the text's own settings do not give.

Each experiment changes one thing in the paper's estimate and shows the cell that it moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from paper.measurements import SNR, Measurement, measure
from paper.pooled import in_order
from paper.published import PUBLISHED
from paper.runs import DEGREES, SAMPLES
from paper.sampled import sampled_objectives
from paper.search import fmaxsearch
from paper.systems import SCENARIOS, Scenario, System, draw, systems
from paper.table import NUMBERS

Floats: TypeAlias = NDArray[np.float64]
Negative: TypeAlias = Literal["kept", "cut off", "shifted up"]


@dataclass(frozen=True)
class Experiment:
    """The paper's estimate of one cell, with one thing changed.

    Attributes
    ----------
    name : str
    system, scenario : str
    samples : int
        R.
    common : bool
        Whether all features share their sample offsets.
    spread : float
        Standard deviation σ of the features.
    snr : float
        Peak of one feature over the noise's standard deviation.
    negative : str
        What becomes of negative pixels.
    steps : tuple of float or None
        Start simplex in radians and units; None for fminsearch's 5 %.
    double : bool
        Whether coordinates and look-ups have double precision.
    most_runs : int
        As many of the table's runs at most.
    """

    name: str
    system: str
    scenario: str
    samples: int = SAMPLES
    common: bool = True
    spread: float = 5.0
    snr: float = SNR
    negative: Negative = "kept"
    steps: tuple[float, float] | None = None
    double: bool = False
    most_runs: int = 100


EXPERIMENTS = (
    Experiment("start simplex of 0.03 rad and 3 units", "1", "I", steps=(0.03, 3.0)),
    Experiment("double precision", "1", "I", double=True),
    Experiment("as in the table", "2", "I"),
    Experiment("fresh samples for every feature", "2", "I", common=False),
    Experiment("double precision", "2", "I", double=True),
    Experiment("R = 10000", "2", "I", samples=10 * SAMPLES),
    Experiment(
        "R = 10000, double precision", "2", "I", samples=10 * SAMPLES, double=True, most_runs=40
    ),
    Experiment("σ² = 5 in place of σ = 5", "2", "I", spread=float(np.sqrt(5.0))),
    Experiment(
        "R = 10000, double precision",
        "2",
        "III-as-printed",
        samples=10 * SAMPLES,
        double=True,
        most_runs=40,
    ),
    Experiment("σ² = 5 in place of σ = 5", "3", "I", spread=float(np.sqrt(5.0))),
    Experiment("negative pixels cut off", "1", "IV", negative="cut off"),
    Experiment("negative pixels shifted up", "1", "IV", negative="shifted up"),
    Experiment("noise of half a peak", "1", "IV", snr=2.0),
    Experiment("noise of half a peak, shifted up", "1", "IV", snr=2.0, negative="shifted up"),
    Experiment("R = 10000", "2", "IV", samples=10 * SAMPLES),
    Experiment("noise of half a peak", "2", "IV", snr=2.0),
    Experiment("noise of half a peak, R = 10000", "2", "IV", samples=10 * SAMPLES, snr=2.0),
    Experiment("the same, cut off", "2", "IV", samples=10 * SAMPLES, snr=2.0, negative="cut off"),
    Experiment("noise of half a peak", "3", "IV", snr=2.0),
    Experiment("noise of half a peak, shifted up", "3", "IV", snr=2.0, negative="shifted up"),
)


def error(experiment: Experiment, seed: int, number: int) -> Floats:
    """Error (6,) of one run, in degrees and units; poses, starts and noise as in the table."""
    cv2.setNumThreads(1)
    truth, start = draw(np.random.default_rng([seed, number]))
    system, scenario, noise = _cell(experiment, seed, number)
    measurements = measure(system, scenario, truth, noise, experiment.snr)
    samples = system.body(scenario).sample(
        experiment.samples,
        antithetic=False,
        common=experiment.common,
        seed=int(noise.integers(2**31)),
    )
    measurements = [_without_negative(one, experiment.negative) for one in measurements]
    paper, _ = sampled_objectives(system, measurements, samples, double=experiment.double)
    steps = None if experiment.steps is None else np.repeat(experiment.steps, 3)
    found = fmaxsearch(paper, start, steps)
    return np.asarray((found - truth) * DEGREES)


def _cell(
    experiment: Experiment, seed: int, number: int
) -> tuple[System, Scenario, np.random.Generator]:
    every = systems(experiment.spread)
    i = [system.name for system in every].index(experiment.system)
    j = [scenario.name for scenario in SCENARIOS].index(experiment.scenario)
    return every[i], SCENARIOS[j], np.random.default_rng([seed, number, i, j])


def _without_negative(measurement: Measurement, negative: Negative) -> Measurement:
    values = measurement.values
    if negative == "cut off":
        values = np.maximum(values, np.float32(0))
    elif negative == "shifted up":
        values = values - values.min()
    return replace(measurement, values=values)


def run_experiments(runs: int, seed: int, console: Console) -> None:
    """Run and print all experiments on the first runs of the table."""
    shown = Table(title="Experiments: the paper's estimate with one thing changed")
    for heading in ("system", "scenario", "changed", "runs"):
        shown.add_column(heading)
    for heading in NUMBERS:
        shown.add_column(heading, justify="right")
    for experiment in EXPERIMENTS:
        count = min(runs, experiment.most_runs)
        task, title = partial(error, experiment, seed), f"{experiment.system} {experiment.name}"
        errors = np.array(in_order(task, range(count), title, None))
        _add_row(shown, experiment, count, np.sqrt((errors**2).mean(axis=0)))
    console.print(shown)


def _add_row(shown: Table, experiment: Experiment, runs: int, rms: Floats) -> None:
    cell = (experiment.system, experiment.scenario)
    shown.add_row(*cell, experiment.name, str(runs), *(f"{x:.3g}" for x in rms))
    published = PUBLISHED[experiment.system][experiment.scenario]
    shown.add_row(*cell, "  published", "300", *(f"{x:.3g}" for x in published), style="dim")

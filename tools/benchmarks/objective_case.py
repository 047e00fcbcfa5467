"""One evaluation of the paper's objective against the look-ups in it and the literal method.

System 2 of the paper, scenario I: two parallel-beam cameras, N = 6 features, R = 1000 samples.
"""

from __future__ import annotations

import argparse
from typing import Any, TypeAlias
from unittest import mock

import cv2
import numpy as np
from numpy.typing import NDArray
from paper.measurements import Measurement, measure
from paper.runs import views
from paper.systems import SCENARIOS, draw, pose, systems

from benchmarks.literal import Camera, LiteralObjective
from benchmarks.timing import PROCESSOR, Task, medians, show
from mixpose.density import DRAWING
from mixpose.objective import View, region_of_interest
from mixpose.objective.paper import PaperObjective, SampledTerm, sampled_terms
from mixpose.rigid import transform
from mixpose.sensors import ParallelBeam

Floats: TypeAlias = NDArray[np.float64]

SAMPLES = 1000


def run(_: argparse.Namespace) -> dict[str, Any]:
    beta, seen, measurements, samples = scene()
    T = pose(beta)
    sigmas = [view.observation.sigma for view in seen]
    plain = PaperObjective(value_terms(seen, samples, T), samples)
    graded = PaperObjective(sampled_terms(seen, samples, sigmas, T), samples)
    flat = samples.reshape(-1, 3)
    images = cameras(measurements)
    literal = LiteralObjective(images, flat)
    slow = LiteralObjective(images, flat, "RegularGridInterpolator")
    difference = abs(literal(beta) / float(plain.value(T)) - 1)
    seconds = medians(
        {
            "value": lambda: plain.value(T),
            "remap": remaps_in(lambda: plain.value(T)),
            "linearise": lambda: graded.linearise(T[None]),
            "remap with gradients": remaps_in(lambda: graded.linearise(T[None])),
        },
        rounds=60,
        calls=20,
        clock=PROCESSOR,
    )
    seconds |= medians(
        {
            "ours": lambda: plain.value(T),
            "literal": lambda: literal(beta),
            "interpolator": lambda: slow(beta),
        },
        rounds=30,
        calls=20,  # an optimiser evaluates again and again
        clock=PROCESSOR,
    )
    figures = {
        "ratio_to_remap": seconds["value"] / seconds["remap"],
        "literal_ratio": seconds["literal"] / seconds["ours"],
        "literal_interpolator_ratio": seconds["interpolator"] / seconds["ours"],
        "gradient_ratio_to_remap": seconds["linearise"] / seconds["remap with gradients"],
        "relative_difference": difference,
    }
    figures |= {f"{name.replace(' ', '_')}_us": 1e6 * s for name, s in seconds.items()}
    print("objective: N = 6, R = 1000, two cameras, one pose")
    for name in ("remap", "value", "remap with gradients", "linearise", "literal", "interpolator"):
        show(f"{name}, µs", 1e6 * seconds[name])
    show("value / its cv2.remap calls", figures["ratio_to_remap"], at_most=1.6)
    show("value, gradient and curvature / theirs", figures["gradient_ratio_to_remap"])
    show("literal (map_coordinates) / value", figures["literal_ratio"], at_least=10)
    show("literal (RegularGridInterpolator) / value", figures["literal_interpolator_ratio"])
    show("relative difference of their values", difference)
    return figures


def scene() -> tuple[Floats, list[View], list[Measurement], Floats]:
    """A true pose β (6,), what is seen there, and samples (N, R, 3)."""
    system, scenario = systems()[1], SCENARIOS[0]
    beta, _ = draw(np.random.default_rng(0))
    measurements = measure(system, scenario, beta, np.random.default_rng(0))
    samples = system.body(scenario).sample(SAMPLES, seed=0)
    return beta, views(system, scenario, measurements), measurements, samples


def value_terms(seen: list[View], samples: Floats, T: Floats) -> list[SampledTerm]:
    """Densities without gradients: all that a value needs."""
    terms = []
    for view in seen:
        sigma = view.observation.sigma
        y, _ = view.sensor.project(transform(T, samples.reshape(-1, 3)))
        box = region_of_interest(view.sensor, y, DRAWING.paper_reach * sigma)
        terms.append(SampledTerm(view.sensor, view.observation.density(sigma, box)))
    return terms


def cameras(measurements: list[Measurement]) -> list[Camera]:
    """The same cameras and densities for the literal method."""
    found = []
    for sensor, measured in zip(systems()[1].sensors, measurements, strict=True):
        assert isinstance(sensor, ParallelBeam)
        P = np.zeros((3, 4))
        P[:2] = sensor.T_sensor_world[:2] / sensor.pixel_size
        P[:2, 3] += sensor.principal_point - measured.origin
        P[2, 3] = 1.0
        found.append(Camera(measured.clean / measured.clean.sum(), P))
    return found


def remaps_in(evaluate: Task) -> Task:
    """The calls of cv2.remap that an evaluation makes, with the same arguments, to be repeated."""
    calls = remap_calls(evaluate)

    def repeat() -> None:
        for arguments, named in calls:
            cv2.remap(*arguments, **named)

    return repeat


def remap_calls(evaluate: Task) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Arguments of every call of cv2.remap while a function runs.

    Raises
    ------
    RuntimeError
        If there is none: then there is nothing to compare with.
    """
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
    remap = cv2.remap

    def take_down(*arguments: Any, **named: Any) -> Any:
        calls.append((arguments, named))
        return remap(*arguments, **named)

    with mock.patch.object(cv2, "remap", take_down):
        evaluate()
    if not calls:
        raise RuntimeError("no cv2.remap was called: there is nothing to compare with")
    return calls

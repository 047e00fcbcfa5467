"""What a search is given: how much it may try, what the sensors detected, and the body.

Rows are those of `tools/benchmark.py search`, written N/hidden/false.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import Observation
from mixpose.judgement import JudgementRules
from mixpose.objective import View
from mixpose.records import Floats, GridPattern, Mask, PointPattern, Singles
from mixpose.rigid import perturb, twist_between
from mixpose.sensors import Rays


@dataclass(frozen=True)
class SearchBudget:
    """Limits and thresholds of one search."""

    max_guesses: float = constant(np.inf, "of one search; not its time, so that results repeat")
    max_guesses_live: int = constant(2000, "of a live frame; the last batch is finished")
    sample: int = constant(8, "features or detections that stand for all; of others a multiple")
    shortlist: int = constant(150, "guesses refined; fewer for bodies of more than 8 features")
    max_triples: int = constant(40_000, "of points, all of the most promising: they take 0.1 s")
    max_problems: int = constant(250_000, "triples of rays as triples of features, of one camera")
    min_sine: float = constant(0.02, "of angles between rays or sides: less fixes no depth or turn")
    by_gap: float = constant(
        4.0,
        "gaps of two rays that a point may be off: of ratios of two like errors 6 in 7 are less",
    )
    least_off: float = constant(
        0.3, "of what gates allow that it may be off at least: three times 0.3 σ_ε, as spots err by"
    )
    crowded: float = constant(
        2.0, "detections for a feature above which those drawn far apart are right 2.7 times less"
    )
    alike: float = constant(
        0.05, "of the radius: poses nearer are one; at 0.03 they crowd out one in 150 of 8/4/8"
    )
    convincing: float = constant(0.7, "share of the body met from which guesses are enough")
    sufficient: float = constant(0.45, "the same beyond doubt, or of spread orientations")
    beyond_doubt: float = constant(
        8.0, "nats from which guesses are enough: of 900 frames only mirror images had as much"
    )
    close: float = constant(
        0.3, "σ_ε, RMS up to which less than `convincing` is enough: as spots err by at most"
    )
    outdone: float = constant(
        12.0, "nats behind the best from which poses are out: right ones were 4.2 behind at most"
    )
    repeats: float = constant(
        7.0, "guesses at the best pose, of triples that a rival has too: about e⁻⁷ are left unseen"
    )
    same_pose: float = constant(0.25, "radii between guesses at one pose: as far as a grid slips")
    useful: float = constant(-np.inf, "evidence that a pose must have to be of any use")
    descent_plan: tuple[tuple[float, int], ...] = constant(
        ((1.0, 2), (0.4, 2)),
        "blurs in σ_ε and steps: clutter near features draws less; one at 1.5 before finds no more",
    )
    wide_plan: tuple[tuple[float, int], ...] = constant(
        ((3.0, 1), (1.5, 2), (1.0, 3)), "the same where not all sensors are cameras"
    )
    orientation_step: float = constant(np.pi / 15, "between orientations: 3 ranges 6/0/0 99 of 100")
    orientation_stages: tuple[tuple[float, int, int], ...] = constant(
        ((1.0, 0, 500), (1.0, 3, 300), (0.6, 4, 150), (0.3, 4, 60), (0.0, 6, 24)),
        "power of the blur that such a turn amounts to, steps and survivors, in these rows",
    )

    @property
    def batch(self) -> int:
        """Problems solved together: in the cache, at a few numbers each; two batches at least."""
        return int(min(4096, self.max_guesses // 2))

    @property
    def hopeless(self) -> float:
        """Evidence that no fit saves: fits gain 3 nats or, of a board in motion, 12."""
        return -self.outdone - self.beyond_doubt

    def limited(self) -> SearchBudget:
        """The same for a frame of a live stream, which comes back to what is left."""
        return replace(self, max_guesses=self.max_guesses_live, shortlist=3 * self.sample)

    def refined(self, features: int) -> int:
        """Guesses refined of a body: as many features in all, but a quarter of the guesses."""
        return max(self.shortlist * self.sample // max(features, self.sample), self.shortlist // 4)


THOROUGH = SearchBudget()
LIVE = THOROUGH.limited()


@dataclass(frozen=True)
class SensorDetections:
    """One sensor with its detections, all of the same weight.

    A bright blob is not worth more features than a faint one, nor are two that merged.
    """

    view: View
    points: Floats  # (M, m) in sensor coordinates; none where features leave no points
    rays: Rays | None  # None for sensors without lines of sight

    @property
    def sigma(self) -> float:
        """σ_ε of the sensor."""
        return self.view.observation.sigma

    @cached_property
    def moments(self) -> tuple[Floats, float]:
        """Mean (m,) of what the sensor saw, and root mean square distance from it."""
        places, weights = self.view.observation.pattern.spots
        mean = weights @ places / weights.sum()
        variance = weights @ ((places - mean) ** 2).sum(axis=1) / weights.sum()
        return mean, float(np.sqrt(variance))


def sensor_detections(views: Sequence[View], body: Body | None = None) -> list[SensorDetections]:
    """Detections of all views that saw something; of densities the peaks, if a body has points."""
    sensors = []
    for view in views:
        seen, pattern = view.observation, view.observation.pattern
        if seen.is_empty:
            continue
        points = np.zeros((0, seen.dimension))
        if not isinstance(pattern, GridPattern):
            points = pattern.points[pattern.weights > 0]
        elif seen.dimension == 2 and body is not None and is_pointlike(body):
            points = peaks(pattern, seen.sigma)
        if len(points):
            seen = Observation(PointPattern(points, np.ones(len(points))), seen.sigma)
        even = replace(view, observation=seen)
        sensors.append(SensorDetections(even, points, view.sensor.rays(points)))
    return sensors


def largest_error(sensor: SensorDetections, rules: JudgementRules) -> float:
    """Of a sensor's detections, in its units."""
    return rules.noise.errors.met * sensor.sigma


def can_fix(detections: Sequence[SensorDetections], body: Body, free: Mask) -> bool:
    """Whether detections have as many coordinates as a pose has free directions (6,)."""
    if not all(len(one.points) for one in detections):
        return True  # of a density nobody knows
    features = len(body.nodes.points)
    told = sum(min(len(one.points), features) * one.points.shape[1] for one in detections)
    return bool(detections) and told >= int(np.count_nonzero(free))


def is_pointlike(body: Body) -> bool:
    """Whether every feature of a body is a point."""
    return len(body.nodes.points) == len(body)


def peaks(pattern: GridPattern, sigma: float) -> Floats:
    """Local maxima (M, 2), highest first, of an image that is blurred by `sigma`, sensor units."""
    spread = max(sigma / pattern.step, 0.5)
    blurred: Singles = cv2.GaussianBlur(  # type: ignore[assignment]
        np.asarray(pattern.values, dtype=np.float32), (0, 0), spread, borderType=cv2.BORDER_CONSTANT
    )
    size = 2 * max(round(spread), 1) + 1
    highest = cv2.dilate(blurred, np.ones((size, size), np.uint8))
    places = np.array(np.nonzero((blurred >= highest) & (blurred > 0.1 * blurred.max())))
    places = places[:, np.argsort(-blurred[tuple(places)], kind="stable")[: 8 * THOROUGH.sample]]
    inner = np.clip(places, 1, np.array(blurred.shape)[:, None] - 2)
    # tops of parabolas through three neighbours, within half a step
    around = np.array([[-1], [0], [1]])
    before, here, after = np.stack(
        [blurred[inner[0] + around, places[1]], blurred[places[0], inner[1] + around]], axis=1
    ).astype(np.float64)
    slope, bend = 0.5 * (after - before), 2.0 * here - before - after
    shift = np.clip(slope / np.maximum(bend, 1e-12), -0.5, 0.5)
    return np.asarray(pattern.origin + pattern.step * (inner + shift)[::-1].T)


@dataclass(frozen=True, eq=False)
class SearchProblem:
    """What stays the same during a search."""

    detections: Sequence[SensorDetections]
    body: Body
    free: Mask  # (6,) which directions may differ from the reference
    T_reference: Floats  # (4, 4), looked at only where a direction is not free
    rules: JudgementRules = JudgementRules()
    budget: SearchBudget = THOROUGH
    seed: int = 0  # of the order in which guesses are tried, where not all can be

    @cached_property
    def cameras(self) -> list[tuple[SensorDetections, Rays]]:
        """Sensors that detect features which are points, with their lines of sight."""
        return [(one, one.rays) for one in self.detections if one.rays and is_pointlike(self.body)]

    def reach(self, sensor: SensorDetections) -> float:
        """Largest error of a sensor's detections, in its units."""
        return largest_error(sensor, self.rules)

    def allowed(self, poses: Floats) -> Floats:
        """Poses (H, 4, 4) with the held directions of the reference."""
        if self.free.all() or not len(poses):
            return poses
        return perturb(self.T_reference, self.free * twist_between(self.T_reference, poses))

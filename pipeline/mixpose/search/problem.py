"""Inputs of a search: its budget, the detections of each sensor, and the body.

Reasons quote rows of `tools/benchmark.py search` as features/hidden/false detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import Observation
from mixpose.judgement import JudgementRules
from mixpose.objective import View
from mixpose.records import Floats, GridPattern, Mask, PointPattern, Singles, replace
from mixpose.rigid import perturb, twist_between
from mixpose.sensors import Rays


@dataclass(frozen=True)
class SearchBudget:
    """Limits and thresholds of one search."""

    max_guesses: float = constant(np.inf, "of one search; a time limit would not repeat")
    max_guesses_live: int = constant(2000, "of a live frame; the last batch is finished")
    sample: int = constant(8, "features or detections in a small selection; others are multiples")
    shortlist: int = constant(150, "guesses refined; fewer for bodies of more than 8 features")
    max_triples: int = constant(40_000, "of points, all of the most promising: they take 0.1 s")
    max_problems: int = constant(250_000, "triples of rays with triples of features, per camera")
    min_sine: float = constant(0.02, "of angles between rays or sides: less fixes no depth or turn")
    by_gap: float = constant(
        4.0,
        "largest error of a point in gaps of its two rays: 6 of 7 ratios of two errors are less",
    )
    least_off: float = constant(
        0.3, "smallest such error, as a share of the gates: thrice the 0.3 σ_ε that spots err by"
    )
    crowded: float = constant(
        2.0, "detections per feature above which detections far apart are right 2.7 times less"
    )
    alike: float = constant(
        0.05, "of the radius: nearer poses are duplicates, which at 0.03 cost 1 in 150 of 8/4/8"
    )
    convincing: float = constant(0.7, "share of the body met from which guessing stops")
    sufficient: float = constant(0.45, "the same beyond doubt, or instead of all orientations")
    beyond_doubt: float = constant(
        8.0, "nats from which guessing stops: in 900 frames only mirror images had as much"
    )
    close: float = constant(
        0.3, "RMS offset in σ_ε up to which less than `convincing` suffices: the most spots err by"
    )
    outdone: float = constant(
        12.0, "nats behind the best at which poses are dropped: right ones were at most 4.2 behind"
    )
    repeats: float = constant(
        7.0, "guesses at the best pose by triples that a rival shares: misses about e⁻⁷ of rivals"
    )
    same_pose: float = constant(0.25, "radii between guesses at one pose: as far as a grid slips")
    useful: float = constant(-np.inf, "evidence that a pose needs to be of use to the caller")
    descent_plan: tuple[tuple[float, int], ...] = constant(
        ((1.0, 2), (0.4, 2)),
        "blurs in σ_ε and steps: small, as clutter pulls less there; 1.5 before them finds no more",
    )
    wide_plan: tuple[tuple[float, int], ...] = constant(
        ((3.0, 1), (1.5, 2), (1.0, 3)), "the same where not all sensors are cameras"
    )
    orientation_step: float = constant(np.pi / 15, "radians: finds 99 of 100 of 3 ranges 6/0/0")
    orientation_stages: tuple[tuple[float, int, int], ...] = constant(
        ((1.0, 0, 500), (1.0, 3, 300), (0.6, 4, 150), (0.3, 4, 60), (0.0, 6, 24)),
        "rows of the power of the blur that such a step causes, steps, and poses that go on",
    )

    @property
    def batch(self) -> int:
        """Number of problems solved at once: few enough for the cache, at most half of all."""
        return int(min(4096, self.max_guesses // 2))

    @property
    def hopeless(self) -> float:
        """Evidence below which no fit helps: fits gain 3 nats, or 12 of a moving board."""
        return -self.outdone - self.beyond_doubt

    def limited(self) -> SearchBudget:
        """Return the budget of a live frame; the next frame goes on where it was used up."""
        return replace(self, max_guesses=self.max_guesses_live, shortlist=3 * self.sample)

    def refined(self, features: int) -> int:
        """Return how many guesses to refine: fewer of large bodies, but at least a quarter."""
        return max(self.shortlist * self.sample // max(features, self.sample), self.shortlist // 4)


THOROUGH = SearchBudget()
LIVE = THOROUGH.limited()


@dataclass(frozen=True)
class SensorDetections:
    """One sensor with its detections, all of the same weight.

    A bright blob stands for no more features than a faint one, and so do two that merged.
    """

    view: View
    points: Floats  # (M, m) in sensor coordinates; empty where the pattern has no points
    rays: Rays | None  # None for sensors without lines of sight

    @property
    def sigma(self) -> float:
        """σ_ε of the sensor."""
        return self.view.observation.sigma

    def reach(self, rules: JudgementRules) -> float:
        """Return the largest error of the detections, in the sensor's units."""
        return rules.noise.errors.met * self.sigma

    @cached_property
    def moments(self) -> tuple[Floats, float]:
        """Mean (m,) of the sensor's pattern, and its root mean square distance from the mean."""
        places, weights = self.view.observation.pattern.spots
        mean = weights @ places / weights.sum()
        variance = weights @ ((places - mean) ** 2).sum(axis=1) / weights.sum()
        return mean, float(np.sqrt(variance))


def sensor_detections(views: Sequence[View], body: Body | None = None) -> list[SensorDetections]:
    """Return the detections of all views that are not empty; of an image, peaks."""
    detections = []
    for view in views:
        observation, pattern = view.observation, view.observation.pattern
        if observation.is_empty:
            continue
        points = np.zeros((0, observation.dimension))
        if not isinstance(pattern, GridPattern):
            points = pattern.points[pattern.weights > 0]
        elif observation.dimension == 2 and body is not None and is_pointlike(body):
            points = peaks(pattern, observation.sigma)
        if len(points):
            observation = Observation(PointPattern(points, np.ones(len(points))), observation.sigma)
        equal_weights = replace(view, observation=observation)
        detections.append(SensorDetections(equal_weights, points, view.sensor.rays(points)))
    return detections


def can_fix(detections: Sequence[SensorDetections], body: Body, free: Mask) -> bool:
    """Test whether detections have as many coordinates as a pose has free directions (6,)."""
    if not all(len(sensor.points) for sensor in detections):
        return True  # a density has no count of detections
    features = len(body.nodes.points)
    counts = [min(len(sensor.points), features) * sensor.points.shape[1] for sensor in detections]
    return bool(detections) and sum(counts) >= int(np.count_nonzero(free))


def is_pointlike(body: Body) -> bool:
    """Test whether every feature of a body is a point."""
    return len(body.nodes.points) == len(body)


def peaks(pattern: GridPattern, sigma: float) -> Floats:
    """Return local maxima (M, 2) of an image blurred by `sigma`, highest first, sensor units."""
    spread = max(sigma / pattern.step, 0.5)
    blurred: Singles = cv2.GaussianBlur(  # type: ignore[assignment]
        np.asarray(pattern.values, dtype=np.float32), (0, 0), spread, borderType=cv2.BORDER_CONSTANT
    )
    size = 2 * max(round(spread), 1) + 1
    highest = cv2.dilate(blurred, np.ones((size, size), np.uint8))
    places = np.array(np.nonzero((blurred >= highest) & (blurred > 0.1 * blurred.max())))
    places = places[:, np.argsort(-blurred[tuple(places)], kind="stable")[: 8 * THOROUGH.sample]]
    inner = np.clip(places, 1, np.array(blurred.shape)[:, None] - 2)
    # maxima are refined by a parabola through three neighbours, by half a step at most
    steps = np.array([[-1], [0], [1]])
    before, centre, after = np.stack(
        [blurred[inner[0] + steps, places[1]], blurred[places[0], inner[1] + steps]], axis=1
    ).astype(np.float64)
    slope, bend = 0.5 * (after - before), 2.0 * centre - before - after
    shift = np.clip(slope / np.maximum(bend, 1e-12), -0.5, 0.5)
    return np.asarray(pattern.origin + pattern.step * (inner + shift)[::-1].T)


@dataclass(frozen=True, eq=False)
class SearchProblem:
    """The inputs of one search, which stay the same during it."""

    detections: Sequence[SensorDetections]
    body: Body
    free: Mask  # (6,) which directions may differ from the reference
    T_reference: Floats  # (4, 4), used only where a direction is not free
    rules: JudgementRules = JudgementRules()
    budget: SearchBudget = THOROUGH
    seed: int = 0  # of the random order of guesses, where there are too many to try all

    @cached_property
    def cameras(self) -> list[tuple[SensorDetections, Rays]]:
        """Sensors with lines of sight to their detections; none unless features are points."""
        sensors = self.detections if is_pointlike(self.body) else ()
        return [(sensor, sensor.rays) for sensor in sensors if sensor.rays]

    def reach(self, sensor: SensorDetections) -> float:
        """Return the largest error of a sensor's detections, in its units."""
        return sensor.reach(self.rules)

    def constrained(self, poses: Floats) -> Floats:
        """Return poses (H, 4, 4) with their held directions set to the reference's."""
        if self.free.all() or not len(poses):
            return poses
        return perturb(self.T_reference, self.free * twist_between(self.T_reference, poses))

"""How much the search may try, and the thresholds that decide when it may stop.

Every field says what it is and where it comes from: a derivation, a test, or a row of
`tools/benchmark.py search` (written N/hidden/false).  They are no options of a session.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.constants import constant


@dataclass(frozen=True)
class PeakOptions:
    """Which maxima of grey values count as detections."""

    max_peaks: int = constant(64, "peaks kept, highest first: more are noise on every recording")
    height: float = constant(0.15, "of the highest peak: lower maxima of a blurred spot are noise")
    grey_floor: float = constant(0.1, "of the largest value: below it a profile is background")


@dataclass(frozen=True)
class EvidenceOptions:
    """What counts as met, and what a miss costs."""

    gate: float = constant(3.0, "σ_ε within which a detection is met: 99 % of errors in a plane")
    neighbours: int = constant(3, "detections about one by which crowding is judged")
    sharpest: float = constant(0.1, "of σ_ε: errors are not believed to be smaller")
    missed: float = constant(
        float(np.log(0.3)), "log-odds of a feature in view without a detection; half are common"
    )


@dataclass(frozen=True)
class DescentOptions:
    """How guesses are refined."""

    damping: float = constant(1e-3, "share of the curvature added: directions without any stay")
    max_turn: float = constant(0.35, "rad in one step: farther the linear model holds no longer")
    same: float = constant(0.01, "of the body's radius: poses nearer to each other are one")
    alike: float = constant(
        0.03, "of the radius, root mean square over features: candidates nearer than this are one"
    )


@dataclass(frozen=True)
class SearchBudget:
    """Limits and thresholds of one search."""

    max_guesses: int | None = constant(
        None, "guesses of one search, counted and not timed, so that results repeat; None: thorough"
    )
    gate: float = constant(3.0, "largest error of a detection in σ_ε: 99 % of errors in a plane")
    max_points: int = constant(200, "triangulated points kept, the most promising first")
    max_prosac_points: int = constant(50, "of them all triples are tried: 19,600, which take 0.1 s")
    random_triples: int = constant(20_000, "triples of all points that are tried after them")
    max_triangles: int = constant(120_000, "of features kept for a body: all of 50 features")
    triangles_alike: int = constant(16, "of features tried for three points, the nearest in shape")
    min_height: float = constant(0.05, "of a triangle by its longest side: flatter fix no turn")
    batch: int = constant(1000, "triples of points between two looks at what was found")
    subsample: int = constant(10, "features far apart that stand for a body in guesses and tests")
    max_anchors: int = constant(24, "points with which two rays are combined, least error first")
    max_rays: int = constant(20, "rays of a camera that are combined with a point, far apart")
    max_pairs: int = constant(20_000, "pairs of places on rays for one point as one feature")
    max_problems: int = constant(250_000, "triples of rays as triples of features, of one camera")
    exhaustive: int = constant(
        8, "features, and half as many again rays, of which all triples are tried first"
    )
    chunk: int = constant(4096, "problems solved together: numbers stay in the cache")
    min_pixels: float = constant(3.0, "apart in the image, for two features to be told apart")
    min_sine: float = constant(0.02, "of the angle between rays: below it no depth is fixed")
    max_together: int = constant(100_000, "features times poses tested together: cache size")
    test_features: int = constant(16, "features by which many guesses are compared at first")
    shortlist: int = constant(300, "guesses refined; fewer for bodies of more than 8 features")
    min_shortlist: int = constant(40, "guesses refined at least, for bodies of many features")
    behind: float = constant(3.0, "detections that a refined guess may explain less than the best")
    distinct: float = constant(0.05, "of the body's radius: guesses nearer to each other are one")
    convincing: float = constant(
        0.7, "share of the body that must be met for no other kind of guess to be made"
    )
    sufficient: float = constant(
        0.45, "the same at overwhelming evidence, and for no spread orientations to be tried"
    )
    overwhelming: float = constant(
        24.0, "evidence in nats that leaves no doubt: a million guesses make 14"
    )
    max_slip_features: int = constant(120, "of a body up to which shifts by a grid step are tried")
    place_steps: int = constant(12, "Newton steps from a start to where the body's middle is")
    turn_steps: int = constant(3, "Newton steps of the place for an assumed orientation")
    max_places: int = constant(4, "places of the body's middle that are kept")
    different: float = constant(0.2, "of the body's radius: middles nearer to each other are one")
    heading_step: float = constant(float(np.radians(4.0)), "between headings, for one free axis")
    orientation_step: float = constant(
        float(np.radians(12.0)), "between spread orientations: 3 ranges 6/0/0 99 of 100"
    )
    orientation_blur: float = constant(
        0.2, "of the spread in a sensor: what a turn by such a step moves features by"
    )
    orientation_stages: tuple[tuple[float, int, int], ...] = constant(
        ((1.0, 0, 500), (1.0, 3, 300), (0.6, 4, 150), (0.3, 4, 60), (0.0, 6, 24)),
        "power of that blur, steps and survivors of each stage: 3 ranges 6/0/0 99 of 100",
    )
    descent_plan: tuple[tuple[float, int], ...] = constant(
        ((1.5, 2), (0.75, 2), (0.4, 2)),
        "blurs in σ_ε and steps: clutter beside a feature draws less; from 3 on, 8/4/8 loses 1 %",
    )
    wide_plan: tuple[tuple[float, int], ...] = constant(
        ((3.0, 1), (1.5, 2), (1.0, 3)), "the same where not all sensors are cameras"
    )
    final_plan: tuple[tuple[float, int], ...] = constant(
        ((1.5, 1), (1.0, 2)), "the same for the best, where detections err by as much as σ_ε"
    )
    finalists: int = constant(16, "poses refined by the final plan, too")
    checked: int = constant(3, "guesses refined at once to see whether others are needed")
    descent: DescentOptions = DescentOptions()
    peaks: PeakOptions = PeakOptions()
    evidence: EvidenceOptions = EvidenceOptions()


THOROUGH = SearchBudget()
"""Everything is tried."""

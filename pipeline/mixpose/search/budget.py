"""How much the search may try, and the thresholds that decide when it may stop.

Rows are those of `tools/benchmark.py search`, written N/hidden/false.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.constants import constant


@dataclass(frozen=True)
class SearchBudget:
    """Limits and thresholds of one search."""

    max_guesses: float = constant(
        np.inf, "guesses of one search, counted and not timed, so that results repeat"
    )
    max_peaks: int = constant(64, "peaks kept, highest first: more are noise on every recording")
    height: float = constant(0.15, "of the highest peak: lower maxima of a blurred spot are noise")
    grey_floor: float = constant(0.1, "of the largest value: below it a profile is background")
    gate: float = constant(3.0, "largest error of a detection in σ_ε: 99 % of errors in a plane")
    max_points: int = constant(1000, "triangulated points kept, the most promising first")
    max_prosac_points: int = constant(50, "of them all triples are tried: 19,600, which take 0.1 s")
    random_triples: int = constant(20_000, "triples of points near each other tried after them")
    max_triangles: int = constant(120_000, "of features kept for a body: all of 50 features")
    triangles_alike: int = constant(16, "of features tried for three points, the nearest in shape")
    min_height: float = constant(0.05, "of a triangle by its longest side: flatter fix no turn")
    batch: int = constant(
        100, "triples of points first looked at together, then twice as many, up to 8 times"
    )
    subsample: int = constant(8, "features far apart that stand for a body beside a point")
    max_ray_points: int = constant(16, "points that two rays are combined with, best first")
    max_rays: int = constant(24, "rays that are combined with a point, the nearest to it")
    max_pairs: int = constant(500, "pairs of places on rays for one point as one feature")
    max_problems: int = constant(
        250_000, "triples of rays as triples of features, of one camera alone"
    )
    max_shared_problems: int = constant(
        60_000,
        "the same for several cameras together, of which one hit of one is enough: at 30,000 a "
        "body that one of two cameras sees is missed once in 24 frames",
    )
    exhaustive: int = constant(
        8, "features, and half as many again rays, of which all triples are tried first"
    )
    crowds: tuple[int, ...] = constant(
        (8, 16, 32), "nearest detections among which triples are drawn: a body is seen in one place"
    )
    crowded: float = constant(
        2.0,
        "detections for a feature above which those far apart are not tried: of the web cams' "
        "corners the right triples drawn are 2.7 times as many",
    )
    chunk: int = constant(4096, "problems solved together: numbers stay in the cache")
    min_pixels: float = constant(3.0, "apart in the image, for two features to be told apart")
    min_sine: float = constant(0.02, "of the angle between rays: below it no depth is fixed")
    cells: float = constant(
        4.0, "per radius of a disk that is drawn for a detection: its rim is off by an eighth of it"
    )
    max_cells: int = constant(16_000_000, "per camera; larger planes get coarser")
    min_cosine: float = constant(0.1, "to the middle of the rays: at 84° a ray misses the plane")
    max_together: int = constant(100_000, "features times poses tested together: cache size")
    test_features: int = constant(16, "features by which many guesses are compared at first")
    shortlist: int = constant(150, "guesses refined; fewer for bodies of more than 8 features")
    min_shortlist: int = constant(40, "guesses refined at least, for bodies of many features")
    behind: float = constant(3.0, "detections that a refined guess may explain less than the best")
    distinct: float = constant(0.05, "of the body's radius: guesses nearer to each other are one")
    convincing: float = constant(
        0.7, "share of the body that must be met for no other kind of guess to be made"
    )
    sufficient: float = constant(
        0.45, "the same beyond doubt, and for no spread orientations to be tried"
    )
    damping: float = constant(1e-3, "share of the curvature added: directions without any stay")
    max_turn: float = constant(0.35, "rad in one step: farther the linear model holds no longer")
    same: float = constant(0.01, "of the body's radius: refined poses nearer to each other are one")
    alike: float = constant(
        0.03, "of the radius, root mean square over features: candidates nearer than this are one"
    )
    descent_features: int = constant(
        32,
        "features by which guesses descend: the final plan takes all; 100/40 absent 2 times faster",
    )
    survivors: int = constant(150, "guesses left after each blur; fewer lose 1 % of 5/1/5")
    beyond_doubt: float = constant(
        8.0,
        "evidence in nats from which no other kind of guess is made: a frame is ok from 7; of 900 "
        "frames with clutter no other wrong pose had as much than mirror images and near twins",
    )
    promising: float = constant(
        2.0, "the same of a pose that all others found are `outdone` by: chance makes less"
    )
    outdone: float = constant(
        12.0,
        "nats behind the best from which a pose is no candidate: of 470 frames of the rows and of "
        "clutter in space none had the right pose more than 4.2 behind",
    )
    candidates: int = constant(8, "poses told in the end, as far as they are distinct")
    hopeless: float = constant(
        -20.0, "the same whatever is best: fits gain 3 nats or, of a board in motion, 12"
    )
    min_slip_features: int = constant(16, "of a body: with fewer, all poses a step off are met")
    max_slip_features: int = constant(120, "of a body up to which shifts by a grid step are tried")
    place_steps: int = constant(12, "Newton steps from a start to where the body's middle is")
    turn_steps: int = constant(3, "Newton steps of the place for an assumed orientation")
    max_places: int = constant(4, "places of the body's middle that are kept")
    different: float = constant(0.2, "of the body's radius: middles nearer to each other are one")
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
        ((1.0, 2), (0.4, 2)),
        "blurs in σ_ε and steps: clutter beside a feature draws less; one more at 1.5 finds no "
        "more, and takes a quarter longer where two cameras see little else",
    )
    wide_plan: tuple[tuple[float, int], ...] = constant(
        ((3.0, 1), (1.5, 2), (1.0, 3)),
        "the same where not all sensors are cameras",
    )
    finalists: int = constant(16, "guesses refined as rivals of a pose beyond doubt")
    improvement: float = constant(1.1, "factor in detections explained for another such look")
    checked: int = constant(3, "guesses refined at once to see whether others are needed")


THOROUGH = SearchBudget()
"""Everything is tried."""

LIVE = SearchBudget(
    max_guesses=2000,
    chunk=1024,
    shortlist=8,
    min_shortlist=6,
    finalists=4,
    max_rays=12,
    max_pairs=200,
    subsample=6,
    descent_features=16,
)
"""For each frame of a live stream: 2,000 guesses and the rest of the last batch."""

"""How much the search may try, and the thresholds that decide when it may stop.

Rows are those of `tools/benchmark.py search`, written N/hidden/false.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mixpose.constants import constant


@dataclass(frozen=True)
class SearchBudget:
    """Limits and thresholds of one search."""

    max_guesses: float = constant(
        np.inf, "guesses of one search, counted and not timed, so that results repeat"
    )
    sample: int = constant(
        8,
        "features or detections that stand for all where pairs or triples of them are tried; a "
        "small multiple where the cost grows less",
    )
    shortlist: int = constant(150, "guesses refined; fewer for bodies of more than 8 features")
    max_triples: int = constant(
        20_000,
        "triples of points tried, of the most promising in all ways, and as many of points near "
        "each other: they take 0.1 s",
    )
    max_problems: int = constant(
        250_000, "triples of rays as triples of features, of one camera alone"
    )
    cache: int = constant(2**17, "numbers of each array worked on at once: they stay in the cache")
    height: float = constant(
        0.1, "of the largest value of an image or a profile: less is background"
    )
    min_sine: float = constant(
        0.02, "of angles between rays, or of sides: below it no depth and no turn is fixed"
    )
    min_cosine: float = constant(0.1, "to the middle of the rays: at 84° a ray misses the plane")
    cells: float = constant(
        4.0, "per radius of a disk that is drawn for a detection: its rim is off by an eighth of it"
    )
    crowded: float = constant(
        2.0,
        "detections for a feature above which those far apart are not tried: of the web cams' "
        "corners the right triples drawn are 2.7 times as many",
    )
    behind: float = constant(3.0, "detections that a refined guess may explain less than the best")
    alike: float = constant(
        0.05,
        "of the body's radius: poses nearer to each other are one, and refined ones at a fifth of "
        "it; guesses that differ by 0.03 crowd out one right pose in 150 of 8/4/8",
    )
    convincing: float = constant(
        0.7, "share of the body that must be met for no other kind of guess to be made"
    )
    sufficient: float = constant(
        0.45, "the same beyond doubt, and for no spread orientations to be tried"
    )
    beyond_doubt: float = constant(
        8.0,
        "evidence in nats from which no other kind of guess is made: a frame is ok from 7; of 900 "
        "frames with clutter no other wrong pose had as much than mirror images and near twins",
    )
    outdone: float = constant(
        12.0,
        "nats behind the best from which a pose is no candidate: of 470 frames of the rows and of "
        "clutter in space none had the right pose more than 4.2 behind",
    )
    improvement: float = constant(1.1, "factor in detections explained for another such look")
    checked: int = constant(3, "guesses refined at once to see whether others are needed")
    damping: float = constant(1e-3, "share of the curvature added: directions without any stay")
    max_turn: float = constant(0.35, "rad in one step: farther the linear model holds no longer")
    descent_plan: tuple[tuple[float, int], ...] = constant(
        ((1.0, 2), (0.4, 2)),
        "blurs in σ_ε and steps: clutter near a feature draws less; one more at 1.5 finds no "
        "more, and takes a quarter longer where two cameras see little else",
    )
    wide_plan: tuple[tuple[float, int], ...] = constant(
        ((3.0, 1), (1.5, 2), (1.0, 3)),
        "the same where not all sensors are cameras",
    )
    place_steps: int = constant(12, "Newton steps from a start to where the body's middle is")
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

    @cached_property
    def batch(self) -> int:
        """Problems solved together: a few numbers each, and two batches at least."""
        return int(min(self.cache // 32, self.max_guesses // 2))

    @property
    def promising(self) -> int:
        """Points of which all triples are tried: n (n - 1) (n - 2) / 6 is `max_triples` or less."""
        return int(np.cbrt(6 * self.max_triples)) + 1

    def problems_for(self, cameras: int) -> int:
        """Triples of rays of one of some cameras.

        Of several, a hit of one is enough: at half of this, a body that one of two cameras sees is
        missed once in 24 frames.
        """
        return self.max_problems // (4 * cameras) if cameras > 1 else self.max_problems

    @property
    def hopeless(self) -> float:
        """Evidence that no fit saves: fits gain 3 nats or, of a board in motion, 12."""
        return -self.outdone - self.beyond_doubt

    def refined(self, features: int) -> int:
        """Guesses refined of a body: as many features in all, but a quarter of the guesses."""
        return max(self.shortlist * self.sample // max(features, self.sample), self.shortlist // 4)


THOROUGH = SearchBudget()
"""Everything is tried."""

LIVE = SearchBudget(max_guesses=2000, shortlist=24)
"""For each frame of a live stream: 2,000 guesses and the rest of the last batch."""

"""What a search finds, what it cost, and where it goes on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """A pose that may explain the views.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    evidence : float
        What candidates are ranked by: logarithm of the odds that this is not chance; with ranges
        among the sensors, the matched objective at the finest blur, summed over views, every
        detection counting alike.
    """

    T_world_object: Floats
    evidence: float


@dataclass(frozen=True)
class SearchReport:
    """What a search cost.

    Attributes
    ----------
    made : int
        Guesses.
    tested : int
        Guesses counted on all features and sensors.
    refined : int
        Guesses that descended.
    """

    made: int = 0
    tested: int = 0
    refined: int = 0

    def joined(self, other: SearchReport | None) -> SearchReport:
        """The cost of two searches."""
        if other is None:
            return self
        return SearchReport(
            self.made + other.made, self.tested + other.tested, self.refined + other.refined
        )


@dataclass(frozen=True)
class SearchState:
    """Where a search with a limited budget goes on in the next frame.

    Attributes
    ----------
    kind : int
        Kind of guess, after the first, which is tried in every frame.
    batch : int
        Batches of it that were tried.
    """

    kind: int = 0
    batch: int = 0


@dataclass(frozen=True)
class SearchResult:
    """Candidates, best first, what they cost, and where to go on while none convinces."""

    candidates: list[Candidate]
    report: SearchReport
    state: SearchState

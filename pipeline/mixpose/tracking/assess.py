"""What a judged pose is worth by itself, worked out once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement import AcceptanceRules, ScoredPose, convinces, is_possible, is_sure


@dataclass(frozen=True)
class Checks:
    """What a judged pose is worth by itself; each check holds only where those before it do."""

    is_possible: bool  # worth telling
    is_sure: bool  # believed, if no rival casts doubt on it
    convinces: bool  # near its prediction, needs no other to compare with


NOTHING = Checks(is_possible=False, is_sure=False, convinces=False)
"""Where there is no pose."""


def assess(judged: ScoredPose, free: NDArray[np.bool_], rules: AcceptanceRules) -> Checks:
    """Check a pose."""
    possible = is_possible(judged, free, rules)
    sure = possible and is_sure(judged, free, rules)
    return Checks(possible, sure, sure and convinces(judged, free, rules))

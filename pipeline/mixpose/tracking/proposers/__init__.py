"""Where poses of a frame come from, in the order in which they are tried.

A proposer yields starts for a frame, given the poses found so far; it says itself when it applies.
A refinement yields rivals of one judged pose.  A new one is a file and a line here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from mixpose.judgement import ScoredPose
from mixpose.tracking.likelihood import FrameData, Likelihood, Start
from mixpose.tracking.proposers.look_alikes import look_alikes
from mixpose.tracking.proposers.merged_pair import merged_pair
from mixpose.tracking.proposers.multistart import multistart
from mixpose.tracking.proposers.narrowed import narrowed
from mixpose.tracking.proposers.predicted import predicted
from mixpose.tracking.proposers.searched import searched
from mixpose.tracking.proposers.without_sensor import without_sensor


class Proposer(Protocol):
    """Starts for a frame, given the poses found so far, the most evident first."""

    __name__: str

    def __call__(self, data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
        """Where fits may begin; nothing where the proposer does not apply."""


class Refinement(Protocol):
    """Starts that may do better than one judged pose."""

    __name__: str

    def __call__(
        self, data: FrameData, likelihood: Likelihood, judged: ScoredPose
    ) -> Iterable[Start]:
        """Where fits may begin; nothing where the pose leaves nothing to mend."""


PROPOSERS: tuple[Proposer, ...] = (predicted, multistart, searched, look_alikes)
REFINEMENTS: tuple[Refinement, ...] = (without_sensor, merged_pair, narrowed)

"""All that is believed but not measured, in one value."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.fit import FitRules
from mixpose.judgement import AcceptanceRules, JudgementRules
from mixpose.search import LIVE, THOROUGH, SearchBudget
from mixpose.tracking.course import CourseRules
from mixpose.tracking.motion import MotionRules
from mixpose.tracking.proposal_rules import ProposalRules
from mixpose.tracking.range_rules import RangeRules
from mixpose.tracking.static_clutter import StaticRules


@dataclass(frozen=True)
class Rules:
    """What a tracker goes by; `docs/constants.md` lists every field."""

    fit: FitRules = FitRules()
    judgement: JudgementRules = JudgementRules()
    acceptance: AcceptanceRules = AcceptanceRules()
    motion: MotionRules = MotionRules()
    course: CourseRules = CourseRules()
    ranges: RangeRules = RangeRules()
    proposals: ProposalRules = ProposalRules()
    static: StaticRules = StaticRules()
    search: SearchBudget = THOROUGH
    live: SearchBudget = LIVE

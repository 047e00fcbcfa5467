"""All that is assumed and not measured, in one value."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant
from mixpose.fit import FitRules
from mixpose.judgement import AcceptanceRules, JudgementRules
from mixpose.search import LIVE, THOROUGH, SearchBudget
from mixpose.tracking.motion import MotionRules
from mixpose.tracking.sizes import SizeRules


@dataclass(frozen=True)
class ProposalRules:
    """What the proposers of `mixpose.tracking.proposers` go by."""

    drawn: int = constant(512, "poses scored: one is off by less than a third in all directions")
    kept: int = constant(5, "of these, starts that are refined; modes of agreeing detections")
    steps: int = constant(3, "Newton steps of these at each blur: the fit does the remaining ones")
    narrowing: float = constant(3.0, "drawn poses are so much surer than starts; searched: squared")
    sets: int = constant(100, "sets of detections: of half wrong, three right ones are in one of 8")
    whole: int = constant(
        30,
        "ok poses, before which images of a flat body are seen as a whole: what was followed so "
        "far may be its mirror image",
    )
    seconds: int = constant(3, "candidates for a second pose: of clutter the best is the likeliest")
    fallen: float = constant(
        0.5,
        "of the log evidence per coordinate of the pose before: offsets are seven times as large",
    )
    static: int = constant(10, "frames without the body, all with a lamp; moving things in two")
    believed: int = constant(3, "ok poses, after which no mirror image is sought")


@dataclass(frozen=True)
class LookAlikeRules:
    """Which look-alikes of a body are rivals; see `mixpose.body.look_alikes`."""

    kinds: tuple[str, ...] = constant(
        ("congruent", "tilted", "mirrored"), "features like others, other tilt, mirror image"
    )
    alike: float = constant(0.05, "of the smaller radius: how far partners may be apart")
    behind: float = constant(50.0, "nats at σ_ε: rivals gain 25 by narrow blurs; 25 make no odds")
    plane: float = constant(
        1e-3, "radii, and radians, by which a mirror, such as a polished table, is not plane"
    )
    fewer: float = constant(1.5, "features fewer that a rival may meet: each is e⁴ in odds, or so")
    flat: float = constant(0.15, "thickness by smaller width below which what is met may be tilted")
    aside: float = constant(0.25, "rad of lines of sight from their middle: wider ones show a tilt")
    by_chance: float = constant(14.0, "coordinates beyond six met by chance: 5 points, 2 cameras")


@dataclass(frozen=True)
class RangeRules:
    """What is assumed about single ranges."""

    max_features: int = constant(8, "of a body: each doubles the number of subsets in the sum")
    stated_degrees: float = constant(20.0, "degrees of freedom that σ_ε counts as, as stated")
    min_information: float = constant(0.02, "of that of known labels: least in any direction")
    modes: int = constant(
        32, "starts around a prediction: 16 left a right maximum unseen in 2 frames of 440"
    )
    behind: float = constant(25.0, "nats behind the best, from which ends of climbs make no odds")
    overlooked: float = constant(0.1, "share of searches that miss a right maximum: 9 of 89")


@dataclass(frozen=True)
class TimingRules:
    """How velocity and delays are estimated, where sensors see their own moments."""

    linear: float = constant(0.1, "σ_ε: no climb with a velocity that moves features by less")
    settled: float = constant(2e-3, "σ_ε: the last change of velocity moves features by less")
    asked: int = constant(3, "frames, of which one is used for unknown delays: to save time")


@dataclass(frozen=True)
class Rules:
    """The rules of a tracker; `docs/constants.md` lists every field."""

    fit: FitRules = FitRules()
    judgement: JudgementRules = JudgementRules()
    acceptance: AcceptanceRules = AcceptanceRules()
    motion: MotionRules = MotionRules()
    ranges: RangeRules = RangeRules()
    timing: TimingRules = TimingRules()
    sizes: SizeRules = SizeRules()
    proposals: ProposalRules = ProposalRules()
    look_alikes: LookAlikeRules = LookAlikeRules()
    search: SearchBudget = THOROUGH
    live: SearchBudget = LIVE


@dataclass(frozen=True)
class SceneRules:
    """How detections are shared out among bodies."""

    gate: float = constant(6.0, "σ_ε around expected features: matches within 2.2, more for motion")
    touching: float = constant(3.0, "σ_ε between images that run together: twice a spot's width")
    pulled: float = constant(0.1, "offset² in σ_ε² of a spot of two bodies: 2.5 times a blob's")
    thorough: int = constant(
        10, "frames, of which one is seen as a whole, and searched for long missing bodies: 1/3 s"
    )

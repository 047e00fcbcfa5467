"""All that is believed but not measured, in one value."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant
from mixpose.fit import FitRules
from mixpose.judgement import AcceptanceRules, JudgementRules
from mixpose.search import LIVE, THOROUGH, SearchBudget
from mixpose.tracking.motion import MotionRules
from mixpose.tracking.static_clutter import StaticRules


@dataclass(frozen=True)
class ProposalRules:
    """What the proposers of `mixpose.tracking.proposers` go by."""

    drawn: int = constant(
        512, "poses scored around a prediction: one lies within a third of the uncertainty in six"
    )
    kept: int = constant(5, "of these, starts that descend")
    steps: int = constant(3, "Newton steps that these take at each blur: the fit takes the rest")
    narrowing: float = constant(
        3.0,
        "how much surer, and at a narrower blur, drawn poses are than starts; searched: squared",
    )
    blurs: tuple[float, ...] = constant(
        (0.5, 0.25), "σ_ε, from which fits go on where spots that are cut or merged bend the pose"
    )
    believed: int = constant(
        3, "poses that are ok, in spite of the mirror image, after which it is no longer looked for"
    )


@dataclass(frozen=True)
class LookAlikeRules:
    """Which look-alikes of a body are rivals; see `mixpose.body.look_alikes`."""

    kinds: tuple[str, ...] = constant(
        ("congruent", "tilted", "mirrored"), "features like others, other tilt, mirror image"
    )
    alike: float = constant(0.05, "of the smaller radius: how far partners may be apart")
    fewer: float = constant(
        1.5, "features fewer that a rival may meet: each is worth four of the log odds, or so"
    )
    flat: float = constant(0.15, "thickness by smaller width below which a body may be tilted")
    by_chance: float = constant(
        14.0,
        "coordinates met beyond six up to which it may be by chance: 5 features, 2 cameras",
    )


@dataclass(frozen=True)
class RangeRules:
    """What is believed of single ranges."""

    max_features: int = constant(8, "of a body: the subsets that are summed double with each")
    stated_degrees: float = constant(20.0, "degrees of freedom that σ_ε counts as, as stated")
    min_information: float = constant(0.02, "of that of known labels, which any direction has")


@dataclass(frozen=True)
class Rules:
    """What a tracker goes by; `docs/constants.md` lists every field."""

    fit: FitRules = FitRules()
    judgement: JudgementRules = JudgementRules()
    acceptance: AcceptanceRules = AcceptanceRules()
    motion: MotionRules = MotionRules()
    ranges: RangeRules = RangeRules()
    proposals: ProposalRules = ProposalRules()
    look_alikes: LookAlikeRules = LookAlikeRules()
    static: StaticRules = StaticRules()
    search: SearchBudget = THOROUGH
    live: SearchBudget = LIVE


@dataclass(frozen=True)
class SceneRules:
    """How detections are shared out, and when bodies are in doubt for each other's sake."""

    gate: float = constant(
        6.0, "σ_ε around expected features: they are met within 2.2, predictions err by the rest"
    )
    rival: float = constant(
        0.5, "share of its detections that another meets from which it is the one or the other"
    )
    touching: float = constant(
        3.0, "σ_ε from a spot to another body's feature: images run together at twice their width"
    )
    pulled: float = constant(
        0.1, "squared offset in σ_ε² from which such a spot is both's: 2.5 times that of blobs"
    )
    thorough: int = constant(
        10, "frames, of which one is searched thoroughly for a body that is away, others not: 1/3 s"
    )

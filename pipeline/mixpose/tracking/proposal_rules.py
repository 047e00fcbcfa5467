"""When poses are proposed, and how many."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class ProposalRules:
    """What the proposers of `mixpose.tracking.proposers` go by."""

    slipped: float = constant(
        0.5, "of a feature, more that are missed and more beside it that belong to none: a step"
    )
    drawn: int = constant(
        512, "poses scored around a prediction: one lies within a third of the uncertainty in six"
    )
    kept: int = constant(5, "of these, starts that are fitted")
    narrowing: float = constant(
        3.0,
        "how much surer than a start a drawn or mirrored pose is, and how much narrower the blur "
        "at which drawn ones are scored; one that was searched for, by its square",
    )
    flat: float = constant(
        0.15, "thickness of a body against its smaller width below which it may be tilted"
    )
    in_plane: float = constant(
        2.2,
        "σ_ε by which features may be out of their plane and still meet what their mirror image "
        "shows: as far as one is met",
    )

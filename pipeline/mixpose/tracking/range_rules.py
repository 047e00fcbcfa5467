"""What is believed of single ranges before they are seen."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class RangeRules:
    """What is believed of single ranges."""

    max_features: int = constant(
        8, "of a body, up to which associations are summed: their subsets double with each"
    )
    stated_degrees: float = constant(
        20.0, "degrees of freedom that σ_ε counts as, where residuals say otherwise"
    )
    min_information: float = constant(
        0.02, "of the information of known labels: what a pose has in any direction"
    )

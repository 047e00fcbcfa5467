"""When a predicted feature counts as met by a detection."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class AssociationRules:
    """When a feature counts as met."""

    min_share: float = constant(
        0.3,
        "share of a feature's peak density from which it is met: within 1.55 standard deviations "
        "of C, 2.2 σ_ε; false features pass for true ones beyond (search rows)",
    )
    min_region: float = constant(
        20.0,
        "σ_ε: features crowd at least over so wide a region, so that two that are close do not "
        "make the density of clutter infinite",
    )
    crowded: bool = constant(
        True, "whether clutter is as dense as detections around the body, where they are denser"
    )
    merged: bool = constant(
        True, "whether two features may share one detection: blobs that touch have one centre"
    )
    slip: float = constant(
        0.25,
        "of the body's size in the image: around its box, a grid shifted by a step has detections "
        "that belong to no feature (chessboards have steps of 1/8)",
    )

    @property
    def reach_squared(self) -> float:
        """Squared distance within which a feature is met, in variances of C."""
        return -2 * math.log(self.min_share)

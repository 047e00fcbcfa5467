"""What the user says about estimation, and what fits go by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from mixpose.constants import constant
from mixpose.objective import ObjectiveName
from mixpose.records import Mask
from mixpose.rigid import TWIST_NAMES

SearchName: TypeAlias = Literal["thorough", "live"]


@dataclass(frozen=True)
class EstimatorOptions:
    """The keys of ``[estimator]`` in a session file."""

    objective: ObjectiveName = "matched"
    free: tuple[str, ...] = TWIST_NAMES  # world directions that are estimated
    samples: int = 1000  # R per feature, where q is integrated by sampling
    seed: int = 0
    fuse: bool = True  # whether frames of single ranges take the pose before them as a prior
    # how long a frame is searched where no prediction convinces; None: live for cameras and streams
    search: SearchName | None = None

    @cached_property
    def mask(self) -> Mask:
        """As `free_mask` has it."""
        mask = np.array([name in self.free for name in TWIST_NAMES])
        mask.flags.writeable = False
        return mask


def free_mask(options: EstimatorOptions) -> Mask:
    """Which of the six directions are estimated, not to be written to."""
    return options.mask


@dataclass(frozen=True)
class FitRules:
    """How a fit begins and ends, and when a body does not fit."""

    ratio: float = constant(
        1.8, "blur from level to level: below 2, a peak lies in the basin of the next level's"
    )
    widest: float = constant(
        0.1, "of the observed extent: with wider blurs everything is one blob (design study)"
    )
    near: float = constant(
        0.1,
        "value per sensor from which the fit begins at σ_ε: features have a third of their peak "
        "on average; below, it descends through the blurs",
    )
    narrower: float = constant(0.8, "of a blur: the next is drawn where it is narrower by as much")
    moved: float = constant(
        0.5,
        "standard deviations by which narrower blurs have to move the pose: where all offsets are "
        "normal they do so, too, as they are 5 % less efficient in six directions",
    )
    believed: float = constant(
        0.99, "probability of χ² up to which a misfit is taken for noise: one frame in a hundred"
    )
    unlike: float = constant(
        0.3, "spread of the features' brightness, relative: markers of one kind under one lamp"
    )

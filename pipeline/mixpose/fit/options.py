"""What the user says about estimation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np

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


@lru_cache
def free_mask(options: EstimatorOptions) -> Mask:
    """Which of the six directions are estimated, not to be written to."""
    mask = np.array([name in options.free for name in TWIST_NAMES])
    mask.flags.writeable = False
    return mask

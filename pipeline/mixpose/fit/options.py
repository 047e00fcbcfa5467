"""What the user says about estimation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.objective import ObjectiveName
from mixpose.rigid import TWIST_NAMES

SearchName: TypeAlias = Literal["thorough", "live"]


@dataclass(frozen=True)
class EstimatorOptions:
    """The keys of ``[estimator]`` in a session file.

    Attributes
    ----------
    objective : {"matched", "paper", "independent"}
    free : tuple of str
        World directions that are estimated, of `mixpose.rigid.TWIST_NAMES`; the rest stay where
        the start has them.
    samples : int
        R, samples per feature where q is integrated by sampling.
    seed : int
    fuse : bool
        Whether frames of single ranges take the pose before them as a prior.
    search : {"thorough", "live"} or None
        How long a frame is searched where no prediction convinces; None: live for cameras and
        streams.
    """

    objective: ObjectiveName = "matched"
    free: tuple[str, ...] = TWIST_NAMES
    samples: int = 1000
    seed: int = 0
    fuse: bool = True
    search: SearchName | None = None


@lru_cache
def free_mask(options: EstimatorOptions) -> NDArray[np.bool_]:
    """Which of the six directions are estimated, not to be written to."""
    mask = np.array([name in options.free for name in TWIST_NAMES])
    mask.flags.writeable = False
    return mask

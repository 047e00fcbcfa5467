"""Random numbers keyed by what they are for.

Each use has a generator of its own, so that neither the order of the sensors nor what else is
drawn in a frame changes a number.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What random numbers decide."""

    MOTION = 1
    ORIENTATION = 2
    BRIGHTNESS = 3
    FRAME = 4
    MISSING = 5
    DEFORMATION = 6
    SCENERY = 7
    TURNED = 8


def generator(seed: int, purpose: Purpose, *key: int) -> np.random.Generator:
    """The generator for one purpose; `key` tells frames and sensors apart."""
    return np.random.default_rng([seed, int(purpose), *key])

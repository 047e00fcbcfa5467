"""Uniform point sets from which feature densities are sampled.

Every feature takes the *same* set: sampling errors then shift all features alike instead of
deforming the body, which makes the angles of an estimate several times more accurate at the same
number of samples.  Antithetic sets (u and 1 − u) cancel the mean error of symmetric densities.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Sampler: TypeAlias = Literal["latin-hypercube", "low-discrepancy"]

DIMENSIONS = 5  # three for a feature's spread, one along a line, one along gravity


def uniforms(
    count: int,
    *,
    sampler: Sampler = "latin-hypercube",
    antithetic: bool = True,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Draw R = `count` points (R, 5) of the open unit cube, strictly between 0 and 1.

    Latin hypercube is the paper's `lhsnorm`, the other a scrambled Sobol sequence.  Of antithetic
    points the second half mirrors the first, and the odd one of an odd count is left out.  Raises
    `ValueError` if the count is below 2 or the sampler is unknown.
    """
    if count < 2:
        raise ValueError(f"{count} samples, at least 2 are needed")
    from scipy.stats import qmc  # noqa: PLC0415 - scipy.stats takes a second to import

    drawn = count // 2 if antithetic else count
    rng = np.random.default_rng(seed)
    if sampler == "latin-hypercube":
        points = qmc.LatinHypercube(DIMENSIONS, rng=rng).random(drawn)
    elif sampler == "low-discrepancy":
        # Sobol points are balanced only in powers of two: draw the next one and keep the first
        exponent = int(np.ceil(np.log2(max(drawn, 2))))
        points = qmc.Sobol(DIMENSIONS, rng=rng).random_base2(exponent)[:drawn]
    else:
        raise ValueError(f"sampler {sampler!r}, allowed are latin-hypercube, low-discrepancy")
    if antithetic:
        points = np.concatenate([points, 1.0 - points])
    smallest = np.finfo(np.float64).eps
    return np.asarray(np.clip(points, smallest, 1.0 - smallest), dtype=np.float64)

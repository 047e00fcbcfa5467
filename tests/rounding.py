"""How far rounding may take a result, whatever the processor and the order of its sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

ULPS = 400
"""Of the largest number that takes part.

A product of poses or a solution of a few equations rounds some ten times per number, the order of
sums and fused multiplications differ between processors: 10 units in the last place were seen.  A
mistake of any use for a test is millions of them.
"""


def rounding(*terms: ArrayLike) -> float:
    """Tolerance for what is computed from numbers of this size: `ULPS` of the largest."""
    largest = max(float(np.abs(term).max()) for term in terms)
    return ULPS * float(np.finfo(np.float64).eps) * largest

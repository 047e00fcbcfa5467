"""MATLAB's fminsearch: Nelder-Mead as the paper started and stopped it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Floats: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-4
STEPS_PER_NUMBER = 200


def fmaxsearch(
    function: Callable[[Floats], float],
    start: Floats,
    steps: Floats | None = None,
    tolerance: float = TOLERANCE,
) -> Floats:
    """Maximise from a start (n,) with fminsearch's simplex, tolerances and budget.

    The simplex moves each coordinate by 5 %, a zero by 0.00025, or by `steps` (n,); both
    tolerances are absolute and both must be met.
    """
    if steps is None:
        steps = np.where(start != 0, 0.05 * start, 0.00025)
    simplex = np.vstack([start, start + np.diag(steps)])
    budget = STEPS_PER_NUMBER * len(start)
    result = minimize(
        lambda x: -function(x),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "xatol": tolerance,
            "fatol": tolerance,
            "maxiter": budget,
            "maxfev": budget,
        },
    )
    return np.asarray(result.x, dtype=np.float64)

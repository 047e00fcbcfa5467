"""What detections of one system must err by so that it is as accurate as another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from mixpose.design.prediction import Plan

_WIDEST = 1e4  # times the noise: beyond it nobody would build the system


def noise_to_equal(plan: Plan, wanted: float, error_of: Callable[[Plan], float]) -> float | None:
    """Factor on all noises of a plan with which an error of it is as wanted.

    Parameters
    ----------
    wanted : float
        The error of the other system.
    error_of : callable
        Of a plan; grows with its noises.

    Returns
    -------
    float or None
        None where the errors of markers alone are too large, or no factor is large enough.
    """

    def excess(log_factor: float) -> float:
        return float(np.log(error_of(scaled(plan, float(np.exp(log_factor)))) / wanted))

    low, high = -np.log(_WIDEST), np.log(_WIDEST)
    if not (np.isfinite(wanted) and np.isfinite(error_of(plan))):
        return None
    if excess(low) > 0 or excess(high) < 0:
        return None
    return float(np.exp(brentq(excess, low, high, xtol=1e-10)))


def scaled(plan: Plan, factor: float) -> Plan:
    """The plan with all noises times a factor, and the widths that go with them."""
    noises, sigmas = (tuple(each * factor for each in all_) for all_ in (plan.noises, plan.sigmas))
    return replace(plan, noises=noises, sigmas=sigmas)

"""Least squares as terms: minus half the squares of residuals, which one step minimises."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mixpose.optimise.ascent import Quadratic, solved
from mixpose.records import Floats, Mask


def squares_of(residuals: Floats, J: Floats) -> Quadratic:
    """Second-order models of minus half the squares of residuals (H, K), J (H, K, q) off a step."""
    columns = J.swapaxes(1, 2)
    gradient = (columns @ residuals[..., None])[..., 0]
    return Quadratic(-0.5 * (residuals**2).sum(axis=1), gradient, columns @ J)


class LinearResiduals(NamedTuple):
    """Residuals that a step (q,) lowers by J times it."""

    J: Floats  # (K, q)
    residuals: Floats  # (K,)


def least_squares(*terms: LinearResiduals, free: Mask | None = None) -> tuple[Floats, Floats]:
    """The step (q,) that leaves the least squares of all terms, and its information (q, q).

    In free directions, or all; those that nothing tells of stay where they are.
    """
    first, *rest = terms
    information, gradient = first.J.T @ first.J, first.J.T @ first.residuals
    for one in rest:
        information = information + one.J.T @ one.J
        gradient = gradient + one.J.T @ one.residuals
    if free is None:
        return solved(information, gradient, 0.0), information
    known = free.astype(np.float64)
    step = solved(information * (known * known[:, None]), gradient * known, 0.0)
    return step, information

"""What is summed to an objective: every evidence and all knowledge is a term."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from mixpose.records import Floats


class Quadratic(NamedTuple):
    """Second-order models at H states: value + gᵀδ − ½ δᵀCδ of q numbers."""

    value: Floats  # (H,)
    gradient: Floats  # (H, q)
    curvature: Floats  # (H, q, q), symmetric, positive semidefinite
    hessian: Floats | None = None  # minus the second derivatives (H, q, q); may be indefinite
    source: Any = None  # what a term computed them from, for those who read more than a model

    def of(self, rows: Any) -> Quadratic:
        """The models at some of the states."""
        hessian = None if self.hessian is None else self.hessian[rows]
        return Quadratic(self.value[rows], self.gradient[rows], self.curvature[rows], hessian)


class Term(Protocol):
    """A function of a state, to be maximised."""

    def linearise(self, states: Any) -> Quadratic:
        """Second-order models at H states, which have a leading axis H."""
        ...


@dataclass(frozen=True)
class Sum:
    """The sum of terms, which is a term."""

    terms: tuple[Term, ...]

    def linearise(self, states: Any) -> Quadratic:
        """Second-order models at H states; Hessians where all terms know theirs."""
        parts = [term.linearise(states) for term in self.terms]
        hessians = [part.hessian for part in parts if part.hessian is not None]
        return Quadratic(
            np.asarray(sum(part.value for part in parts)),
            np.asarray(sum(part.gradient for part in parts)),
            np.asarray(sum(part.curvature for part in parts)),
            np.asarray(sum(hessians)) if len(hessians) == len(parts) else None,
        )

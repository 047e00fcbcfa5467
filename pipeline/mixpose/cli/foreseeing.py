"""Poses that are published for a little later than their frames."""

from __future__ import annotations

from collections.abc import Callable

from mixpose.records import Estimate
from mixpose.session import Session
from mixpose.tracking import Foreseen


def foreseeing(session: Session, seconds: float) -> dict[str, Callable[[Estimate], Estimate]]:
    """For each body of a session, by label, what foretells its poses so many seconds ahead."""
    return {
        label: _foresee(Foreseen(one.body), seconds)
        for one in session.objects
        for label in one.labels
    }


def _foresee(known: Foreseen, seconds: float) -> Callable[[Estimate], Estimate]:
    """Follows the estimates that it is called with."""

    def foresee(estimate: Estimate) -> Estimate:
        nonlocal known
        known = known.after(estimate)
        return known.ahead(estimate, seconds)

    return foresee

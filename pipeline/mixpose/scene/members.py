"""The bodies of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mixpose.records import label_of
from mixpose.tracking import Tracker


@dataclass(frozen=True)
class Member:
    """One body of a scene.

    Attributes
    ----------
    tracker : Tracker
    instance : int or None
        Which of identical ones, whose trackers have the same `Body`; None where there is one only.
    """

    tracker: Tracker
    instance: int | None = None

    @property
    def label(self) -> str:
        """The body in one word."""
        return label_of(self.tracker.body.name, self.instance)


def groups(members: Sequence[Member]) -> list[list[int]]:
    """Numbers of the members that are identical, group by group; none of those that are alone."""
    alike: dict[int, list[int]] = {}
    for k, member in enumerate(members):
        alike.setdefault(id(member.tracker.body), []).append(k)
    return [group for group in alike.values() if len(group) > 1]

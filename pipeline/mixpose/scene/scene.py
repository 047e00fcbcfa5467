"""The bodies of a scene from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mixpose.objective import View
from mixpose.records import Estimate, label_of
from mixpose.tracking import Track, Tracker


@dataclass(frozen=True)
class Member:
    """One body of a scene.

    Attributes
    ----------
    tracker : Tracker
    instance : int or None
        Which of identical ones; None where there is one only.
    """

    tracker: Tracker
    instance: int | None = None

    @property
    def label(self) -> str:
        """The body in one word."""
        return label_of(self.tracker.body.name, self.instance)


class Outcome(NamedTuple):
    """A frame of one body: what is known after it, and its estimate."""

    track: Track
    estimate: Estimate


@dataclass(frozen=True)
class Scene:
    """All bodies that one recording shows, in the order of their pose lines."""

    members: tuple[Member, ...]

    def begin(self) -> tuple[Track, ...]:
        """The tracks before the first frame."""
        return tuple(member.tracker.begin() for member in self.members)

    def advance(
        self, tracks: Sequence[Track], frame: int, time_s: float | None, views: Sequence[View]
    ) -> list[Outcome]:
        """Estimate one frame of every body.

        Parameters
        ----------
        tracks : sequence of Track
            One per member.
        frame : int
        time_s : float or None
        views : sequence of View
            All sensors with a frame.
        """
        outcomes = []
        for member, track in zip(self.members, tracks, strict=True):
            after, estimate = member.tracker.advance(track, frame, time_s, views)
            outcomes.append(Outcome(after, replace(estimate, instance=member.instance)))
        return outcomes

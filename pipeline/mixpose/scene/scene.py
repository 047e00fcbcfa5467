"""The bodies of a scene from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mixpose.objective import View
from mixpose.records import Estimate
from mixpose.scene.joint import Joint
from mixpose.scene.members import Member
from mixpose.scene.rules import SceneRules
from mixpose.tracking import Track


class Outcome(NamedTuple):
    """A frame of one body: what is known after it, and its estimate."""

    track: Track
    estimate: Estimate


@dataclass(frozen=True)
class Scene:
    """All bodies that one recording shows, in the order of their pose lines."""

    members: tuple[Member, ...]
    rules: SceneRules = SceneRules()

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
        if len(self.members) == 1:
            member, track = self.members[0], tracks[0]
            after, estimate = member.tracker.advance(track, frame, time_s, views)
            return [Outcome(after, replace(estimate, instance=member.instance))]
        joint = Joint(self.members, tracks, frame, time_s, views, self.rules)
        joint.solve()
        verdicts = [
            member.tracker.verdict(joint.data[k], joint.ranked[k])
            for k, member in enumerate(self.members)
        ]
        outcomes = []
        for k, member in enumerate(self.members):
            tracker, verdict, ranked = member.tracker, verdicts[k], joint.ranked[k]
            estimate = tracker.estimate(frame, time_s, views, verdict, ranked)
            after = tracker.followed(joint.data[k], frame, time_s, verdict)
            after = replace(after, doubted=verdict.status != "ok")
            outcomes.append(Outcome(after, replace(estimate, instance=member.instance)))
        return outcomes

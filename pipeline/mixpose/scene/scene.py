"""The bodies of a scene from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mixpose.judgement import ScoredPose, Verdict
from mixpose.objective import View
from mixpose.records import Estimate
from mixpose.scene.doubt import may_be_another
from mixpose.scene.identity import identify
from mixpose.scene.joint import Joint
from mixpose.scene.members import Member, groups
from mixpose.scene.rules import SceneRules
from mixpose.tracking import Companion, Track
from mixpose.tracking.likelihood import FrameData
from mixpose.tracking.recognition import TRIANGLE, is_from_doubt, is_known


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
        found = [self._decided(k, joint.data[k], joint.ranked[k]) for k in range(len(self.members))]
        for group in groups(self.members):
            self._identify(group, found, joint.data)
        sure = [one.verdict.status == "ok" and one.told is None for one in found]
        for k, one in enumerate(found):
            best = one.verdict.best
            if sure[k] and best is not None:
                why = may_be_another(k, best, self.members, joint.data, sure)
                found[k] = Decided(one.verdict.doubted(why), one.ranked)
        outcomes = [
            self._outcome(k, found[k], joint.data[k], frame, time_s, views)
            for k in range(len(self.members))
        ]
        return self._acquainted(outcomes)

    def _decided(self, k: int, data: FrameData, ranked: Sequence[ScoredPose]) -> Decided:
        verdict = self.members[k].tracker.verdict(data, ranked)
        best = verdict.best if verdict.status == "ok" else None
        if best and not is_known(data, best):
            # of a body that gives way, three markers may be three of its others
            gives_way = data.body.spread > 0
            verdict = verdict.doubted(TRIANGLE if gives_way or is_from_doubt(data, best) else "")
        return Decided(verdict, ranked)

    def _acquainted(self, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """The same, and where bodies are beside each other; identical ones may be exchanged."""
        sure = {
            member.label: one.estimate.T_world_object
            for member, one in zip(self.members, outcomes, strict=True)
            if member.instance is None and one.estimate.status == "ok"
        }
        after = []
        for member, (track, estimate) in zip(self.members, outcomes, strict=True):
            known, T, body = dict(track.companions), sure.get(member.label), member.tracker.body
            for label, T_other in sure.items() if T is not None else ():
                if label != member.label and T is not None and T_other is not None:
                    known[label] = Companion.joined(known.get(label), T, T_other, body)
            after.append(Outcome(replace(track, companions=known), estimate))
        return after

    def _identify(
        self, group: Sequence[int], found: list[Decided], data: Mapping[int, FrameData]
    ) -> None:
        """Give the poses of identical bodies to those that they belong to, with doubts."""
        poses = {
            k: found[k].verdict.best.T_world_object  # type: ignore[union-attr]
            for k in group
            if found[k].verdict.best is not None
        }
        rules = self.members[group[0]].tracker.rules.acceptance
        told = identify(group, poses, data, rules.rival, self.rules.forgotten)
        by_finder = {k: found[k] for k in group}
        spare = [by_finder[k] for k in group if k not in told.poses.values()]
        for k in group:
            found[k] = by_finder[told.poses[k]] if k in told.poses else spare.pop(0)
        for k, rivals in told.exchanged.items():
            others = [(by_finder[finder].verdict.best, odds) for finder, odds in rivals]
            found[k] = found[k].doubted([(one, odds) for one, odds in others if one is not None])

    def _outcome(
        self,
        k: int,
        found: Decided,
        data: FrameData,
        frame: int,
        time_s: float | None,
        views: Sequence[View],
    ) -> Outcome:
        member, tracker = self.members[k], self.members[k].tracker
        told = found.told or found.verdict
        estimate = tracker.estimate(data, views, told, found.ranked)
        after = tracker.followed(data, found.verdict)
        doubted = found.verdict.status != "ok"
        after = replace(after, doubted=doubted, companions=data.track.companions)
        return Outcome(after, replace(estimate, instance=member.instance))


class Decided(NamedTuple):
    """A body's verdict by itself; what is told of it where others cast doubt; all its poses."""

    verdict: Verdict
    ranked: Sequence[ScoredPose]
    told: Verdict | None = None

    def doubted(self, rivals: Sequence[tuple[ScoredPose, float]]) -> Decided:
        """The same, told to be ambiguous with poses that it may have instead, and their odds."""
        best = self.verdict.best
        if best is None:
            return self
        # odds that it has none, as its pose is another's, stand beside the poses
        total = sum(weight for _, weight in self.verdict.kept) + sum(odds for _, odds in rivals)
        kept = [*self.verdict.kept, *((one, odds) for one, odds in rivals if one is not best)]
        kept = [(one, weight / total) for one, weight in kept]
        first = next(pair for pair in kept if pair[0] is best)
        kept = [first, *sorted((p for p in kept if p is not first), key=lambda p: -p[1])]
        return self._replace(told=Verdict("ambiguous", best, kept))

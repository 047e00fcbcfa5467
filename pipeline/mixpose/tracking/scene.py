"""The bodies that are before the sensors, from frame to frame; a scene of one is a scene.

The poses of a moment are proposed, fitted and judged body by body, on what others leave; identical
bodies are told apart; and each track follows its body.  A scene is a value: `advance` takes tracks
and a frame and returns the next tracks with the estimates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mixpose.judgement import ScoredPose, Verdict
from mixpose.objective import View
from mixpose.records import Estimate
from mixpose.tracking.doubt import may_be_another
from mixpose.tracking.explain import Explanation
from mixpose.tracking.identity import identify
from mixpose.tracking.outcome import estimate_of, followed
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.sharing import Moment, shared_out
from mixpose.tracking.track import Companion, Track
from mixpose.tracking.tracked_body import TrackedBody


class Outcome(NamedTuple):
    """A frame of one body: what is known after it, and its estimate."""

    track: Track
    estimate: Estimate


@dataclass(frozen=True)
class Decided:
    """A body's poses, its verdict by itself, and what is told where others cast doubt."""

    explained: Explanation
    verdict: Verdict
    told: Verdict

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
        return replace(self, told=Verdict("ambiguous", best, kept))


@dataclass(frozen=True)
class Scene:
    """All bodies that are before the sensors, in the order of their pose lines."""

    bodies: tuple[TrackedBody, ...]
    rules: SceneRules = SceneRules()

    def begin(self) -> tuple[Track, ...]:
        """The tracks before the first frame."""
        return tuple(tracked.begin() for tracked in self.bodies)

    def advance(
        self, tracks: Sequence[Track], frame: int, time_s: float | None, views: Sequence[View]
    ) -> list[Outcome]:
        """Estimate one frame of every body.

        Parameters
        ----------
        tracks : sequence of Track
            One per body.
        frame : int
        time_s : float or None
        views : sequence of View
            All sensors with a frame; those that saw nothing are reported and left out.

        Returns
        -------
        list of Outcome
            Tracks for the next frame, and estimates without their latency.
        """
        seen = tuple(view for view in views if not view.observation.is_empty)
        moment = Moment(self.bodies, tracks, frame, time_s, seen, len(views), self.rules)
        found = shared_out(moment).found
        decided = self._doubted(self._identified(found), found)
        outcomes = []
        for k, tracked in enumerate(self.bodies):
            data, verdict = found[k].frame, decided[k].verdict
            ranked = decided[k].explained.ranked
            after = followed(tracked, data, verdict)
            estimate = estimate_of(tracked, data, views, decided[k].told, ranked)
            outcomes.append(Outcome(after, replace(estimate, delays=after.delays.seconds)))
        return self._acquainted(outcomes)

    def _identified(self, found: Mapping[int, Explanation]) -> list[Decided]:
        """Poses of identical bodies given to those that they belong to, with doubts."""
        decided = [
            Decided(found[k], found[k].verdict, found[k].verdict) for k in range(len(self.bodies))
        ]
        for group in self._identical():
            told = identify(group, found)
            before = {k: decided[k] for k in group}
            spare = [before[k] for k in group if k not in told.poses.values()]
            for k in group:
                decided[k] = before[told.poses[k]] if k in told.poses else spare.pop(0)
            for k, rivals in told.exchanged.items():
                others = [(before[finder].verdict.best, odds) for finder, odds in rivals]
                decided[k] = decided[k].doubted([(b, odds) for b, odds in others if b is not None])
        return decided

    def _identical(self) -> list[list[int]]:
        """Numbers of the bodies that are identical, group by group."""
        alike: dict[int, list[int]] = {}
        for k, tracked in enumerate(self.bodies):
            alike.setdefault(id(tracked.body), []).append(k)
        return [group for group in alike.values() if len(group) > 1]

    def _doubted(self, decided: list[Decided], found: Mapping[int, Explanation]) -> list[Decided]:
        """The same; in doubt where the pose might as well be another body's, or another one."""
        if len(self.bodies) == 1:  # three markers of it are in doubt in any case
            return decided
        sure = [one.told.status == "ok" for one in decided]
        after = list(decided)
        for k, one in enumerate(decided):
            best = one.verdict.best
            if sure[k] and best is not None:
                verdict = one.verdict.doubted(may_be_another(k, best, self.bodies, found, sure))
                after[k] = replace(one, verdict=verdict, told=verdict)
        return after

    def _acquainted(self, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """The same, and where bodies are beside each other; identical ones may be exchanged."""
        sure = {
            tracked.label: one.estimate.T_world_object
            for tracked, one in zip(self.bodies, outcomes, strict=True)
            if tracked.instance is None and one.estimate.status == "ok"
        }
        if len(self.bodies) == 1:
            return list(outcomes)
        after = []
        for tracked, (track, estimate) in zip(self.bodies, outcomes, strict=True):
            known, T = dict(track.companions), sure.get(tracked.label)
            for label, T_other in sure.items() if T is not None else ():
                if label != tracked.label and T is not None and T_other is not None:
                    known[label] = Companion.joined(known.get(label), T, T_other, tracked.body)
            after.append(Outcome(replace(track, companions=known), estimate))
        return after

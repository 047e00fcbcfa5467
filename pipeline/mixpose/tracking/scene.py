"""The bodies that are before the sensors, from frame to frame; a scene of one is a scene.

The poses of a moment are proposed, fitted and judged body by body, on what others leave; identical
bodies are told apart; and each track follows its body.  A scene is a value: `advance` takes tracks
and a frame and returns the next tracks with the estimates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mixpose.judgement import Verdict
from mixpose.objective import View
from mixpose.records import Estimate
from mixpose.tracking.doubt import look_alike_of
from mixpose.tracking.explain import Explanation, explain
from mixpose.tracking.identity import Rivals, identify
from mixpose.tracking.outcome import estimate_of, followed
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.sharing import Sharing
from mixpose.tracking.track import Companion, Track

if TYPE_CHECKING:
    from mixpose.tracking.tracker import Tracker


@dataclass(frozen=True)
class Scene:
    """All bodies that are before the sensors, in the order of their pose lines."""

    bodies: tuple[Tracker, ...]
    rules: SceneRules = SceneRules()

    def begin(self) -> tuple[Track, ...]:
        """The tracks before the first frame."""
        return tuple(tracked.begin() for tracked in self.bodies)

    def advance(
        self, tracks: Sequence[Track], frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[tuple[Track, ...], list[Estimate]]:
        """Estimate one frame of every body: tracks for the next, and estimates without latency.

        `views` are all sensors with a frame; those that saw nothing are reported and left out.
        """
        if len(self.bodies) == 1:
            data = self.bodies[0].data(tracks[0], frame, time_s, views)
            found = {0: explain(Explanation(self.bodies[0], data, len(views)))}
        else:
            seen = [view for view in views if not view.observation.is_empty]
            sharing = Sharing(self.bodies, tracks, frame, time_s, seen, len(views), self.rules)
            found = sharing.explained()
        finders, rivals = self._identified(found)
        verdicts = {k: found[finders[k]].verdict for k in found}
        told = {k: _in_doubt(verdicts[k], rivals.get(k, [])) for k in found}
        for k, why in self._look_alikes(told, found).items():
            verdicts[k] = told[k] = verdicts[k].doubted(why)
        after, estimates = [], []
        for k, tracked in enumerate(self.bodies):
            shown = told[k].best or next(iter(found[finders[k]].ranked), None)
            after.append(followed(found[k].frame, verdicts[k]))
            given = found[k].frame, views, told[k], shown
            estimates.append(estimate_of(*given, after=after[k], instance=tracked.instance))
        return self._acquainted(after, estimates), estimates

    def _identified(
        self, found: Mapping[int, Explanation]
    ) -> tuple[dict[int, int], dict[int, Rivals]]:
        """By body, the one that found what it gets, and poses that it may have, with odds."""
        finders, rivals = {k: k for k in found}, dict[int, Rivals]()
        groups: dict[int, list[int]] = {}
        for k, tracked in enumerate(self.bodies):
            groups.setdefault(id(tracked.body), []).append(k)
        for group in groups.values():
            if len(group) > 1:
                given, exchanged = identify(group, found)
                finders, rivals = finders | given, rivals | exchanged
        return finders, rivals

    def _look_alikes(
        self, told: Mapping[int, Verdict], found: Mapping[int, Explanation]
    ) -> dict[int, str]:
        """Why sure poses might as well be another body's that is not surely elsewhere."""
        doubts = {}
        sure = {k: verdict.best for k, verdict in told.items() if verdict.status == "ok"}
        for k, best in sure.items() if len(self.bodies) > 1 else ():
            # a body's own markers may repeat themselves: then it may be turned another way
            others = [
                found[j].frame
                for j, other in enumerate(self.bodies)
                if j == k or not (j in sure or other.body is self.bodies[k].body)
            ]
            if best is not None and (why := look_alike_of(found[k].frame, best, others)):
                doubts[k] = why
        return doubts

    def _acquainted(
        self, tracks: Sequence[Track], estimates: Sequence[Estimate]
    ) -> tuple[Track, ...]:
        """The tracks, and where bodies are beside each other; identical ones may be exchanged."""
        sure = {
            tracked.label: one.T_world_object
            for tracked, one in zip(self.bodies, estimates, strict=True)
            if tracked.instance is None and one.status == "ok"
        }
        after = list(tracks)
        for k, tracked in enumerate(self.bodies):
            T, known = sure.get(tracked.label), dict(tracks[k].companions)
            for label, T_other in sure.items():
                if T is not None and T_other is not None and label != tracked.label:
                    known[label] = Companion.joined(known.get(label), T, T_other, tracked.body)
                    after[k] = replace(tracks[k], companions=known)
        return tuple(after)


def _in_doubt(verdict: Verdict, rivals: Rivals) -> Verdict:
    """The same, told to be ambiguous with poses that it may have instead, and their odds."""
    best = verdict.best
    if best is None or not rivals:
        return verdict
    # odds that it has none, as its pose is another's, stand beside the poses
    total = sum(weight for _, weight in [*verdict.kept, *rivals])
    kept = [*verdict.kept, *((pose, odds) for pose, odds in rivals if pose is not best)]
    kept = [(pose, weight / total) for pose, weight in kept]
    kept.sort(key=lambda pair: (pair[0] is not best, -pair[1]))
    return Verdict("ambiguous", best, kept)

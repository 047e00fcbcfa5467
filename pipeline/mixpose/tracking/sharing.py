"""One moment of several bodies: each is explained by what the others leave, to a fixpoint.

Bodies that convince where they are expected come first, all at once; what they meet is theirs.
The others look at what is left, the most evident is believed, and takes its detections from the
rest.  Where two poses want the same detections, it counts what both bodies explain together if
the one or the other has them; not which stands first in the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mixpose.objective import SharedDensities, View
from mixpose.records import Floats, Indices, Mask
from mixpose.tracking.claims import MERGED, Claims, Met, overlap
from mixpose.tracking.explain import Explanation, explain, judged_by
from mixpose.tracking.likelihood import FrameData
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.together import begun_together
from mixpose.tracking.track import Prediction, Track

if TYPE_CHECKING:
    from mixpose.tracking.tracker import Tracker


@dataclass
class Sharing:
    """What the bodies of a moment explain so far; each step changes `found` and `claimed`."""

    bodies: Sequence[Tracker]
    tracks: Sequence[Track]
    frame: int
    time_s: float | None
    views: Sequence[View]  # that saw anything
    sensors: int  # that had a frame
    rules: SceneRules
    found: dict[int, Explanation] = field(default_factory=dict)  # by body
    claimed: list[int] = field(default_factory=list)  # bodies that have what their poses meet
    merged: Indices = field(default_factory=lambda: np.zeros(0, np.intp))  # spots of two bodies

    def explained(self) -> dict[int, Explanation]:
        """The poses of all bodies."""
        self._where_expected()
        away = [k for k in range(len(self.bodies)) if k not in self.claimed]
        for is_forgotten in (False, True):
            self._on_the_rest([k for k in away if self._is_forgotten(k) == is_forgotten])
        self._without_merged()
        self._judge_again(self.found)
        self._beside_others(away)
        return self.found

    def _where_expected(self) -> None:
        """Bodies that are where they are expected, all at once, until nothing changes hands."""
        some = [
            k
            for k, track in enumerate(self.tracks)
            if track.branches and track.misses == 0 and not track.doubted
        ]
        places = {}
        for k in some:
            first = self.bodies[k].predictions(self.tracks[k], self.frame, self.time_s)[0]
            places[k] = self._nobody.features(self.bodies[k].body, first.T_world_object)
        claims = self._nobody.expected(places, self.rules.gate)
        for _ in range(3):  # neighbours' neighbours are settled by then
            self.found |= self._at_once(some, claims, places)
            self.claimed = [k for k, one in self.found.items() if one.checks.convinces]
            claims = self._claims(self.claimed)
            some = [k for k in self.claimed if self._is_touched(k, claims)]
            if not some:
                break

    def _at_once(
        self, some: Sequence[int], claims: Claims, places: Mapping[int, Floats]
    ) -> dict[int, Explanation]:
        """Bodies around their predictions, by what others leave.

        Those that nothing of the others' is near to look at all that is there, and are fitted
        together.
        """
        left = {k: claims.left(k) for k in some}
        frames = {k: self._data(k, left[k]) for k in some}
        alike = [
            k
            for k in some
            if len(some) > 1
            and len(frames[k].views) == len(self.views)
            and self._shared is not None
            and not claims.are_near(~left[k], places[k], self._reach(k))
        ]
        if alike and self._shared is not None:
            begun = begun_together([frames[k] for k in alike], self._shared)
            frames.update(zip(alike, begun, strict=True))
        return {k: explain(self._begun(k, frames[k], left[k]), quickly=True) for k in some}

    def _is_touched(self, k: int, claims: Claims) -> bool:
        """Whether detections come to or go from a body that it may meet."""
        changed = self.found[k].left ^ claims.left(k)
        places = claims.features(self.bodies[k].body, self.found[k].ranked[0].T_world_object)
        return claims.are_near(changed, places, self._reach(k))

    def _on_the_rest(self, waiting: list[int]) -> None:
        """Bodies that are not where they are expected, on what is left, the most evident first."""
        self._look(waiting)
        while possible := [k for k in waiting if self.found[k].checks.is_possible]:
            winner = self._most_evident(possible)
            self.claimed.append(winner)
            waiting = [k for k in waiting if k != winner]
            touched = [k for k in waiting if self._overlap(k, winner) > 0]
            self._look(touched)
            self._beside_others([k for k in waiting if k not in touched])

    def _look(self, some: Iterable[int]) -> None:
        """By all proposers, on what is left; identical bodies that are forgotten look as one."""
        claims, twins = self._claims(self.claimed), dict[int, Explanation]()
        for k in some:
            body = self.bodies[k].body
            is_twin = self._is_forgotten(k) and sum(one.body is body for one in self.bodies) > 1
            if is_twin and id(body) in twins:
                whole = self._data(k, self._nobody.left(k))
                self.found[k] = replace(twins[id(body)], tracked=self.bodies[k], frame=whole)
                continue
            self.found[k] = self._everywhere(k, claims.left(k), is_twin=is_twin)
            if is_twin:
                twins[id(body)] = self.found[k]

    def _everywhere(self, k: int, left: Mask, *, is_twin: bool) -> Explanation:
        """A body by all proposers, after those that were asked already where the same is left."""
        tracked, track = self.bodies[k], self.tracks[k]
        before, beside = self.found.get(k), self._companion(k)
        if before and beside is before.frame.beside and np.array_equal(before.left, left):
            return explain(before)
        own = replace(self._data(k, left), beside=beside)
        data = own
        if is_twin:
            data = replace(self._data(k, left, replace(track, branches=())), beside=beside)
        is_away = track.misses > tracked.rules.motion.coasting
        # bodies that are there are not held up
        if is_away and self.claimed and track.misses % self.rules.thorough != 0:
            data = replace(data, options=replace(data.options, search="live"))
        found = explain(self._begun(k, data, left))
        return replace(found, frame=replace(own, log=data.log)) if is_twin else found

    def _most_evident(self, possible: Sequence[int]) -> int:
        """The body that is believed next: with it, all that compete explain most."""
        first = max(possible, key=lambda k: self.found[k].evidence)
        for other in possible:
            same = self.bodies[first].body is self.bodies[other].body
            if other == first or (same and all(map(self._is_forgotten, (first, other)))):
                continue
            if self._overlap(first, other) < self.rules.rival:
                continue
            if self.evidence_of_both(first, other) < self.evidence_of_both(other, first):
                first = other
        return first

    def evidence_of_both(self, keeps: int, other: int) -> float:
        """Evidence of two bodies, if the one keeps what it meets and the other has the rest.

        One that the rest says nothing for is taken to be away, which has the odds of clutter.
        """
        claims = self._claims([*(k for k in self.claimed if k != keeps), keeps])
        rest = self._again(other, claims.left(other)).ranked
        return self.found[keeps].evidence + max([0.0, *(one.log_evidence for one in rest[:1])])

    def _without_merged(self) -> None:
        """Take from bodies what may be their feature and another's in one spot, and fit again."""
        met = {k: self._met(k) for k in self.claimed}
        unmet = {k: self._nobody.unmet_by(self.found[k].ranked[0]) for k in self.claimed}
        rules, claims = self.rules, self._claims(self.claimed)
        self.merged = claims.merged(met, unmet, rules.touching, rules.pulled)
        if len(self.merged):
            self._judge_again(self.claimed, fitted=True)

    def _judge_again(self, some: Iterable[int], *, fitted: bool = False) -> None:
        """Judge poses for which other detections are left by now, and fit them to these."""
        claims = self._claims(self.claimed)
        for k in some:
            left = claims.left(k)
            if not np.array_equal(left, self.found[k].left):
                again = self._again(k, left, fitted=fitted)
                if again.ranked or not fitted:
                    self.found[k] = again

    def _beside_others(self, some: Iterable[int]) -> None:
        """Bodies that are not sure, by what was found beside them since they looked."""
        for k in some:
            one = self.found[k]
            if one.ranked and one.verdict.status != "ok":
                before, beside = one.frame.beside, self._companion(k)
                if beside and (before is None or _width(beside) < _width(before)):
                    self.found[k] = self._again(k, one.left, beside)

    def _companion(self, k: int) -> Prediction | None:
        """Where the body is expected beside that sure one which tells most."""
        tracked, told = self.bodies[k], []
        for j in self.claimed:
            known = self.tracks[k].companions.get(self.bodies[j].label)
            if known is not None and self.found[j].verdict.status == "ok":
                T = self.found[j].ranked[0].T_world_object
                told.append(Prediction(*known.expected(T, tracked.body, tracked.rules.motion), 1.0))
        return min(told, key=_width, default=None)

    def _again(
        self, k: int, left: Mask, beside: Prediction | None = None, *, fitted: bool = False
    ) -> Explanation:
        """The poses of a body by what is left for it by now, and fitted to that."""
        before = self.found[k].frame
        data = replace(self._data(k, left), beside=beside or before.beside, log=before.log)
        return judged_by(self._begun(k, data, left), self.found[k].ranked, fitted=fitted)

    def _begun(self, k: int, data: FrameData, left: Mask) -> Explanation:
        return Explanation(self.bodies[k], data, self.sensors, left)

    def _data(self, k: int, left: Mask, track: Track | None = None) -> FrameData:
        """What is left of the frame for a body, and what is known before it."""
        views = self._nobody.part(left)
        return self.bodies[k].data(track or self.tracks[k], self.frame, self.time_s, views)

    @cached_property
    def _nobody(self) -> Claims:
        return Claims.none(self.views)

    def _claims(self, claimed: Sequence[int]) -> Claims:
        """Whose each detection is, if some bodies have what they meet."""
        claims = self._nobody.taken({k: self._met(k) for k in claimed})
        claims.owners[self.merged] = MERGED
        return claims

    def _met(self, k: int) -> Met:
        return self._nobody.met_by(self.found[k].ranked[0], self.found[k].left)

    def _overlap(self, a: int, b: int) -> float:
        if not self.found[a].ranked or not self.found[b].ranked:
            return 0.0
        return overlap(self._met(a), self._met(b))

    @cached_property
    def _shared(self) -> SharedDensities | None:
        """The densities of all that is seen; None where a sensor has no single detections."""
        if any(view.observation.points is None for view in self.views):
            return None
        return SharedDensities.drawn(self.views)

    def _is_forgotten(self, k: int) -> bool:
        """Whether where the body was says nothing any more: no velocity is believed then."""
        track = self.tracks[k]
        return not track.branches or track.misses > self.bodies[k].rules.motion.coasting

    def _reach(self, k: int) -> float:
        """How far from features of body k, in σ_ε, detections pull."""
        return self.bodies[k].rules.judgement.noise.errors.reach


def _width(expected: Prediction) -> float:
    """How little a prediction tells: the logarithm of the volume that it leaves."""
    return float(np.log(expected.uncertainty).sum())

"""One frame of several bodies: each on what the others leave, until nothing changes hands.

Bodies that convince where they are expected come first, all at once; what they meet is theirs.
The others look at what is left, the most evident is believed, and takes its detections from the
rest.  Where two poses want the same detections, it counts what both bodies explain together if
the one or the other has them; not which stands first in the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement import ScoredPose, convinces, is_possible
from mixpose.objective import SharedDensities, View, project_body
from mixpose.records import PointPattern
from mixpose.scene.members import Member
from mixpose.scene.ownership import (
    MERGED,
    Claim,
    Left,
    Owners,
    are_alike,
    claimed,
    claims_of,
    expected_owners,
    hides_near,
    is_reached,
    left_for,
    merged_spots,
    overlap,
    unmet_places,
)
from mixpose.scene.rules import SceneRules
from mixpose.tracking import Prediction, Track
from mixpose.tracking.likelihood import FrameData
from mixpose.tracking.together import begun_together

Floats: TypeAlias = NDArray[np.float64]
Claims: TypeAlias = Mapping[str, Claim]


class Joint:
    """The bodies of one frame, and what each has found so far.

    Attributes
    ----------
    data : dict of int to FrameData
        By member: the frame as it is left for it.
    ranked : dict of int to list of ScoredPose
        Its poses, most evident first.
    """

    def __init__(
        self,
        members: Sequence[Member],
        tracks: Sequence[Track],
        frame: int,
        time_s: float | None,
        views: Sequence[View],
        rules: SceneRules,
    ) -> None:
        self.members, self.tracks = members, tracks
        self.data: dict[int, FrameData] = {}
        self.ranked: dict[int, list[ScoredPose]] = {}
        self._frame, self._time_s, self._rules = frame, time_s, rules
        self._views = [view for view in views if not view.observation.is_empty]
        self._left: dict[int, Left] = {}
        self._owners: dict[int, Owners] = {}
        self._claims: dict[int, Claims] = {}
        self._merged: dict[str, set[int]] = {}
        self._beside: dict[int, Prediction | None] = {}
        self._shared: SharedDensities | None = None
        if self._views and all(
            isinstance(view.observation.pattern, PointPattern) for view in self._views
        ):
            self._shared = SharedDensities.drawn(self._views)

    def solve(self) -> None:
        """Find the poses of all members."""
        self._follow([k for k in range(len(self.members)) if self._is_trusted(k)])
        left = [k for k in range(len(self.members)) if k not in self._claims]
        self._look_for([k for k in left if not self._is_forgotten(k)])
        self._look_for([k for k in left if self._is_forgotten(k)])
        self._part()
        owners = self._owned()
        for k in range(len(self.members)):
            if not are_alike(k, owners, self._owners[k]):
                self._rejudge(k, left_for(k, self._views, owners))
        self._expect(left)

    def _follow(self, trusted: Sequence[int]) -> None:
        """Bodies where they are expected, all at once."""
        expected = {k: self._places(k, self._expected(k)) for k in trusted}
        owners = expected_owners(self._views, expected, self._rules.gate)
        stale = list(trusted)
        for _ in range(self._rules.rounds):
            self._look_where_expected(stale, owners, expected)
            for k in stale:
                self._claims.pop(k, None)
                if self._convinces(k):
                    self._claim(k)
            owners = claimed(self._views, self._claims)
            stale = [k for k in self._claims if self._is_touched(k, owners)]
            if not stale:
                break

    def _look_where_expected(
        self, some: Sequence[int], owners: Owners, places: Mapping[int, Mapping[str, Floats]]
    ) -> None:
        """Poses of bodies on what others leave, around their predictions.

        Those that nothing of the others' is near to may look at all that is there, at once.
        """
        for k in some:
            self._left[k], self._owners[k] = left_for(k, self._views, owners), owners
            tracker, left = self.members[k].tracker, self._left[k]
            self.data[k] = tracker.data(self.tracks[k], self._frame, self._time_s, left.views)
        alike = [k for k in some if self._may_share(self.data[k], self._left[k], places[k])]
        if self._shared is not None and alike:
            begun = begun_together([self.data[k] for k in alike], self._shared)
            self.data.update(zip(alike, begun, strict=True))
        for k in some:
            self.ranked[k] = self.members[k].tracker.ranked(self.data[k], quickly=True)

    def _part(self) -> None:
        """Take from bodies what may be their feature and another's in one spot, and fit again."""
        rules = self._rules
        unmet = {k: unmet_places(self.ranked[k][0]) for k in self._claims}
        found = merged_spots(self._views, self._claims, unmet, rules.touching, rules.pulled)
        if not found:
            return
        for name, numbers in found.items():
            self._merged.setdefault(name, set()).update(numbers)
        owners = self._owned()
        for k in list(self._claims):
            if are_alike(k, owners, self._owners[k]):
                continue
            before = self.ranked[k]
            self._look(k, owners, before)
            if self.ranked[k]:
                self._claim(k)
            else:
                self.ranked[k] = before

    def _owned(self) -> Owners:
        """Owners by all that is claimed so far."""
        owners = claimed(self._views, self._claims)
        for name, numbers in self._merged.items():
            owners[name][list(numbers)] = MERGED
        return owners

    def _look_for(self, others: Sequence[int]) -> None:
        """Bodies that are not where they are expected, on what is left, the most evident first."""
        waiting = list(others)
        self._look_at_all(waiting)
        while waiting:
            possible = [k for k in waiting if self._is_possible(k)]
            if not possible:
                break
            winner = self._most_evident(possible)
            self._claim(winner)
            waiting.remove(winner)
            taken = self._claims[winner]
            again = [k for k in waiting if self._wants(k, taken)]
            self._look_at_all(again)
            self._expect([k for k in waiting if k not in again])

    def _look_at_all(self, some: Iterable[int]) -> None:
        """Everywhere, on what is left; identical bodies of which nothing is known look as one."""
        owners = claimed(self._views, self._claims)
        seen: dict[int, int] = {}
        for k in some:
            tracker = self.members[k].tracker
            twin = seen.get(id(tracker.body)) if self._is_forgotten(k) else None
            if twin is None:
                self._look(k, owners)
                if self._is_forgotten(k):
                    seen[id(tracker.body)] = k
                continue
            self.data[k] = tracker.data(self.tracks[k], self._frame, self._time_s, self._views)
            self.ranked[k] = self.ranked[twin]
            self._left[k], self._owners[k] = self._left[twin], owners

    def _look(self, k: int, owners: Owners, start: Sequence[ScoredPose] = ()) -> None:
        """Poses of a body on what others leave; with `start`, from these poses alone."""
        tracker = self.members[k].tracker
        left = left_for(k, self._views, owners)
        track = self.tracks[k]
        if not start:
            self._beside[k] = self._companion(k)
        if self._is_forgotten(k):
            track = replace(track, branches=())
        data = self._data(k, left, track)
        if self._is_away(k):
            data = replace(data, options=replace(data.options, search="live"))
        self.ranked[k] = tracker.again(data, start, fitted=True) if start else tracker.ranked(data)
        if track is not self.tracks[k]:
            data = replace(self._data(k, left), log=data.log)
        self.data[k], self._left[k], self._owners[k] = data, left, owners

    def _rejudge(self, k: int, left: Left) -> None:
        """The poses of a body again, by what is left for it in the end."""
        data = self._data(k, left)
        self.ranked[k] = self.members[k].tracker.again(data, self.ranked[k], fitted=False)
        self.data[k], self._left[k] = replace(data, log=self.data[k].log), left

    def _data(self, k: int, left: Left, track: Track | None = None) -> FrameData:
        """The frame as it is left for a body, and what is known before it."""
        tracker, track = self.members[k].tracker, track or self.tracks[k]
        data = tracker.data(track, self._frame, self._time_s, left.views)
        return replace(data, beside=self._beside.get(k))

    def _expect(self, some: Iterable[int]) -> None:
        """Bodies that are not sure, by what was found beside them since they looked."""
        for k in some:
            if self.ranked[k] and not self._is_sure(k):
                told = self._companion(k)
                before = self._beside.get(k)
                if told and (before is None or _width(told) < _width(before)):
                    self._beside[k] = told
                    self._rejudge(k, self._left[k])

    def _companion(self, k: int) -> Prediction | None:
        """Where the body is expected beside that sure one which tells most."""
        tracker, told = self.members[k].tracker, []
        for j in self._claims:
            one = self.tracks[k].companions.get(self.members[j].label)
            if one is not None and self._is_sure(j):
                T = self.ranked[j][0].T_world_object
                told.append(Prediction(*one.expected(T, tracker.body, tracker.rules.motion), 1.0))
        return min(told, key=_width, default=None)

    def _is_sure(self, k: int) -> bool:
        verdict = self.members[k].tracker.verdict(self.data[k], self.ranked[k])
        return verdict.status == "ok"

    def _may_share(self, data: FrameData, left: Left, places: Mapping[str, Floats]) -> bool:
        """Whether nothing that is another's lies within reach, so that all may look as one."""
        if self._shared is None or len(data.views) != len(self._views):
            return False
        return not any(
            hides_near(view, left.kept[view.name], places[view.name], self._rules.reach)
            for view in self._views
        )

    def _most_evident(self, possible: Sequence[int]) -> int:
        """The body that is believed next: with it, all that compete explain most."""
        first = max(possible, key=self._evidence)
        for other in possible:
            if other == first or self._is_same(first, other):
                continue
            if overlap(self._own_claims(first), self._own_claims(other)) < self._rules.rival:
                continue
            gain = self.together(first, other) - self.together(other, first)
            if gain < 0:
                first = other
        return first

    def together(self, keeps: int, other: int) -> float:
        """Evidence of two bodies, if the one keeps what it meets and the other has the rest.

        One that the rest says nothing for is taken to be away, which has the odds of clutter.
        """
        claims = {**self._claims, keeps: self._own_claims(keeps)}
        left = left_for(other, self._views, claimed(self._views, claims))
        tracker = self.members[other].tracker
        rest = tracker.again(self._data(other, left), self.ranked[other], fitted=False)
        return self._evidence(keeps) + max([0.0, *(one.log_evidence for one in rest[:1])])

    def _is_trusted(self, k: int) -> bool:
        track = self.tracks[k]
        return bool(track.branches) and track.misses == 0 and not track.doubted

    def _is_forgotten(self, k: int) -> bool:
        """Whether where the body was says nothing any more."""
        track = self.tracks[k]
        return not track.branches or track.misses > self._rules.forgotten

    def _is_away(self, k: int) -> bool:
        """Whether a body was looked for everywhere, and a look here and there will do."""
        rules, misses = self._rules, self.tracks[k].misses
        return misses > rules.forgotten and misses % rules.thorough != 0

    def _is_same(self, a: int, b: int) -> bool:
        """Whether two are identical and nothing tells which is which."""
        same = self.members[a].tracker.body is self.members[b].tracker.body
        return same and self._is_forgotten(a) and self._is_forgotten(b)

    def _expected(self, k: int) -> Floats:
        tracker = self.members[k].tracker
        return tracker.predictions(self.tracks[k], self._frame, self._time_s)[0].T_world_object

    def _convinces(self, k: int) -> bool:
        tracker, ranked = self.members[k].tracker, self.ranked[k]
        return bool(ranked) and convinces(ranked[0], tracker.free, tracker.rules.acceptance)

    def _is_possible(self, k: int) -> bool:
        tracker, ranked = self.members[k].tracker, self.ranked[k]
        return bool(ranked) and is_possible(ranked[0], tracker.free, tracker.rules.acceptance)

    def _evidence(self, k: int) -> float:
        return self.ranked[k][0].log_evidence

    def _own_claims(self, k: int) -> Claims:
        return claims_of(self.ranked[k][0], self._left[k])

    def _claim(self, k: int) -> None:
        self._claims[k] = self._own_claims(k)

    def _wants(self, k: int, taken: Claims) -> bool:
        """Whether a body meets any of some detections."""
        return bool(self.ranked[k]) and overlap(self._own_claims(k), taken) > 0

    def _is_touched(self, k: int, owners: Owners) -> bool:
        before, reach = self._owners[k], self._rules.reach
        if are_alike(k, owners, before):
            return False
        places = self._places(k, self.ranked[k][0].T_world_object)
        return is_reached(k, self._views, owners, before, places, reach)

    def _places(self, k: int, T: Floats) -> dict[str, Floats]:
        """Where the sensors have the features of a body at a pose."""
        sensors = tuple(view.sensor for view in self._views)
        at = project_body(sensors, self.members[k].tracker.body).project(T[None])
        return {
            view.name: at.y[i, 0][at.seen[i, 0]][:, : view.sensor.dimension]
            for i, view in enumerate(self._views)
        }


def _width(expected: Prediction) -> float:
    """How little a prediction tells: the logarithm of the volume that it leaves."""
    return float(np.log(expected.uncertainty).sum())

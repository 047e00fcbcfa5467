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
from typing import Any

import numpy as np

from mixpose.fit import fit_together
from mixpose.judgement import ScoredPose, Verdict, is_possible, judge_together, nearest_alike
from mixpose.objective import SharedDensities, View, can_be_together, matched_objective
from mixpose.records import Floats, Mask
from mixpose.tracking.claims import Claims, Met
from mixpose.tracking.doubt import decided
from mixpose.tracking.frame import Frame
from mixpose.tracking.likelihood import MatchedLikelihood, Start
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.track import Branch, Track
from mixpose.tracking.tracker import Tracker, are_convincing, judged_again


@dataclass(frozen=True, eq=False)
class Explanation:
    """What one body makes of what is left of a frame for it."""

    frame: Frame
    left: Mask  # (D,), see `Claims.left`
    ranked: Sequence[ScoredPose]  # distinct poses, the most evident first

    @cached_property
    def verdict(self) -> Verdict:
        """The decision about the frame, and why it is in doubt."""
        return decided(self.frame, self.ranked)


@dataclass
class Sharing:
    """What the bodies of a moment explain so far; each step changes `found` and `claimed`."""

    bodies: Sequence[Tracker]
    tracks: Sequence[Track]
    frame: int
    time_s: float | None
    views: Sequence[View]  # of all sensors that had a frame
    rules: SceneRules
    found: dict[int, Explanation] = field(default_factory=dict)  # by body
    claimed: list[int] = field(default_factory=list)  # bodies that have what their poses meet
    merged: list[int] = field(default_factory=list)  # detections that are two bodies' in one

    def explained(self) -> dict[int, Explanation]:
        """The poses of all bodies."""
        self._where_expected()
        away = [k for k in range(len(self.bodies)) if k not in self.claimed]
        for is_forgotten in (False, True):
            self._on_the_rest([k for k in away if self._is_forgotten(k) == is_forgotten])
        self._leave_merged()
        self._judge_again()
        self._beside_others(away)
        return self.found

    def _where_expected(self) -> None:
        """Bodies that are where they are expected, all at once, until nothing changes hands."""
        places = {}
        for k, (tracked, track) in enumerate(zip(self.bodies, self.tracks, strict=True)):
            if track.branches and not track.misses and not track.doubted:
                first = tracked.predictions(track, self.frame, self.time_s)[0]
                places[k] = self._nobody.features(tracked.body, first.T_world_object)
        some, claims = list(places), self._nobody.expected(places, self.rules.gate)
        for _ in range(3):  # neighbours' neighbours are settled by then
            self.found |= self._at_once(some, claims, places)
            found = self.found.items()
            self.claimed = [k for k, one in found if are_convincing(one.frame, one.ranked)]
            claims = self._claims(self.claimed)
            changed = {k: self.found[k].left ^ claims.left(k) for k in self.claimed}
            some = [k for k in changed if self._are_near(k, changed[k], self._features(k))]
            if not some:
                break

    def _at_once(
        self, some: Sequence[int], claims: Claims, places: Mapping[int, Floats]
    ) -> dict[int, Explanation]:
        """Bodies around their predictions, by what others leave.

        Those that nothing of the others' is near to see all that is there, and climb together.
        """
        left = {k: claims.left(k) for k in some}
        frames = {k: self._frame(k, left[k]) for k in some}
        if len(some) > 1 and self._shared:
            whole = len(self._shared.totals)
            alike = {k: one for k, one in frames.items() if len(one.views) == whole}
            alike = {k: alike[k] for k in alike if not self._are_near(k, ~left[k], places[k])}
            frames |= climbed_together(alike, self._shared)
        ranked = {k: self.bodies[k].explain(one, quickly=True) for k, one in frames.items()}
        return {k: Explanation(frames[k], left[k], ranked[k]) for k in some}

    def _on_the_rest(self, waiting: list[int]) -> None:
        """Bodies that are not where they are expected, on what is left, the most evident first."""
        self._look(waiting)
        while possible := [k for k in waiting if self._is_possible(k)]:
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
            body, track, left = self.bodies[k].body, self.tracks[k], claims.left(k)
            if self.bodies[k].instance is None or not self._is_forgotten(k):
                self.found[k] = self._everywhere(k, left, track)
                continue
            if id(body) not in twins:
                twins[id(body)] = self._everywhere(k, left, replace(track, branches=()))
            one = twins[id(body)]
            own = self._frame(k, left, beside=one.frame.beside, searches=one.frame.searches)
            self.found[k] = replace(one, frame=own)

    def _everywhere(self, k: int, left: Mask, track: Track) -> Explanation:
        """A body by all proposers; one that is away is not searched for thoroughly each time."""
        data = self._frame(k, left, track, beside=self._companion(k))
        # bodies that are there are not held up
        is_away = track.misses > self.bodies[k].rules.motion.coasting and self.claimed
        if is_away and track.misses % self.rules.thorough:
            data = replace(data, options=replace(data.options, search="live"))
        return Explanation(data, left, self.bodies[k].explain(data))

    def _most_evident(self, possible: Sequence[int]) -> int:
        """The body that is believed next: with it, all that compete explain most."""
        first = max(possible, key=lambda k: self.found[k].ranked[0].log_evidence)
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
        rest = self._again(other, claims.left(other)).ranked[:1]
        kept = self.found[keeps].ranked[0].log_evidence
        return kept + max([0.0, *(one.log_evidence for one in rest)])

    def _leave_merged(self) -> None:
        """Take from bodies what they meet loosely beside another's feature: it is both's."""
        claims = self._claims(self.claimed)
        places = {k: self._features(k) for k in self.claimed}
        for k in self.claimed:
            numbers, squared = self._met(k)
            loose = np.isin(np.arange(len(claims.owners)), numbers[squared > self.rules.pulled])
            others = np.concatenate([places[k][:0], *(places[j] for j in places if j != k)])
            near = claims.near(loose & (claims.owners == k), others, self.rules.touching)
            self.merged += near.tolist()

    def _judge_again(self) -> None:
        """Judge poses for which other detections are left by now; without merged ones, fit them."""
        claims = self._claims(self.claimed)
        for k, one in self.found.items():
            if not np.array_equal(left := claims.left(k), one.left):
                self.found[k] = self._again(k, left, fitted=bool(self.merged))

    def _beside_others(self, some: Iterable[int]) -> None:
        """Bodies that are not sure, by what was found beside them since they looked."""
        for k in some:
            one = self.found[k]
            if one.ranked and one.verdict.status != "ok":
                before, beside = one.frame.beside, self._companion(k)
                if beside and (before is None or _width(beside) < _width(before)):
                    self.found[k] = self._again(k, one.left, beside)

    def _companion(self, k: int) -> Branch | None:
        """Where the body is expected beside that sure one which tells most."""
        tracked, told = self.bodies[k], []
        for j in self.claimed:
            known = self.tracks[k].companions.get(self.bodies[j].label)
            if known and self.found[j].verdict.status == "ok":
                T = self.found[j].ranked[0].T_world_object
                told.append(known.expected(T, tracked.body, tracked.rules.motion))
        return min(told, key=_width, default=None)

    def _again(
        self, k: int, left: Mask, beside: Branch | None = None, *, fitted: bool = False
    ) -> Explanation:
        """The poses of a body by what is left for it by now, and fitted to that."""
        ranked, before = self.found[k].ranked, self.found[k].frame
        beside = beside or before.beside
        data = self._frame(k, left, beside=beside, searches=before.searches)
        return Explanation(data, left, judged_again(data, ranked, fitted=fitted))

    def _frame(self, k: int, left: Mask, track: Track | None = None, **known: Any) -> Frame:
        """What is left of the frame for a body, and what is known before it."""
        track, views = track or self.tracks[k], self._nobody.part(left)
        return replace(self.bodies[k].data(track, self.frame, self.time_s, views), **known)

    @cached_property
    def _nobody(self) -> Claims:
        return Claims.none(self.views)

    def _claims(self, claimed: Sequence[int]) -> Claims:
        """Whose each detection is, if some bodies have what they meet."""
        return self._nobody.taken({k: self._met(k) for k in claimed}, self.merged)

    def _met(self, k: int) -> Met:
        return self._nobody.met_by(self.found[k].ranked[0], self.found[k].left)

    def _overlap(self, a: int, b: int) -> float:
        """Share of the detections of the one that meets fewer that both meet."""
        if not self.found[a].ranked or not self.found[b].ranked:
            return 0.0
        one, other = (set(self._met(k)[0].tolist()) for k in (a, b))
        return len(one & other) / max(min(len(one), len(other)), 1)

    @cached_property
    def _shared(self) -> SharedDensities | None:
        """The densities of all that is seen; None of nothing, or without single detections."""
        seen = [view for view in self.views if not view.observation.is_empty]
        are_single = all(view.observation.points is not None for view in seen)
        return SharedDensities(seen) if seen and are_single else None

    def _is_possible(self, k: int) -> bool:
        """Whether the best pose of a body is worth telling."""
        data, best = self.found[k].frame, self.found[k].ranked[:1]
        return any(is_possible(one, data.free, data.rules.acceptance) for one in best)

    def _is_forgotten(self, k: int) -> bool:
        """Whether where the body was says nothing any more: no velocity is believed then."""
        track = self.tracks[k]
        return not track.branches or track.misses > self.bodies[k].rules.motion.coasting

    def _features(self, k: int) -> Floats:
        return self._nobody.features(self.bodies[k].body, self.found[k].ranked[0].T_world_object)

    def _are_near(self, k: int, chosen: Mask, places: Floats) -> bool:
        """Whether detections (D,) pull at features of body k that are at places (n, 3)."""
        reach = self.bodies[k].rules.judgement.noise.errors.reach
        return len(self._nobody.near(chosen, places, reach)) > 0


def _width(expected: Branch) -> float:
    """How little a prediction tells: the logarithm of the volume that it leaves."""
    return float(np.log(expected.uncertainty).sum())


def climbed_together(frames: Mapping[int, Frame], shared: SharedDensities) -> dict[int, Frame]:
    """The frames of several bodies with what is climbed from their first predictions, and judged.

    `shared` has all that their sensors see; what is not a body's own is out of its reach.
    """
    begun, some = dict(frames), []
    for k, one in frames.items():
        if not one.is_timed:
            drawn = matched_objective(one.views, one.body, one.sigmas, shared=shared)
            begun[k] = replace(one, drawn=drawn)
            if one.options.objective == "matched" and can_be_together(one.body):
                some.append(k)
    if len(some) < 2:
        return begun
    objectives = [begun[k].finest for k in some]
    starts = [begun[k].predictions[0].T_world_object for k in some]
    free, rules = begun[some[0]].free, begun[some[0]].rules
    fits, cases = {}, []
    for k, end in zip(some, fit_together(objectives, starts, free, rules.fit), strict=True):
        if end is not None:
            data = begun[k] = replace(begun[k], drawn=end[0])
            first = data.predictions[0]
            start = Start(first.T_world_object, first.uncertainty)
            fit = fits[k] = MatchedLikelihood(data).fit(start, end[1])
            T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
            seen = (fit.matches, fit.noise) if T is fit.T_world_object else (None, None)
            cases.append((data.finest, T, data.track.residuals, data.prior(T), *seen))
    judged = judge_together(cases, free, rules.judgement) if cases else []
    for (k, fit), pose in zip(fits.items(), judged, strict=True):
        begun[k] = replace(begun[k], together=(fit, pose))
    return begun

"""One moment of several bodies: each is explained by what the others leave, to a fixpoint.

Bodies that are where they are expected come first, all at once; what they meet is theirs.
The others look at what is left, the most evident is believed, whichever stands first in the file,
and takes its detections from the rest, which look again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mixpose.fit import Fit, fit_together
from mixpose.judgement import Case, ScoredPose, Verdict, insert, is_possible, judge_together
from mixpose.objective import SharedDensities, View, has_bare_points, matched_objective
from mixpose.optimise import Ascent
from mixpose.records import Floats, Mask
from mixpose.search import SeenTogether, search_copies
from mixpose.tracking.claims import Claims, Met
from mixpose.tracking.doubt import decided
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import MatchedLikelihood, case_of, likelihood_of
from mixpose.tracking.proposers import is_there, predicted
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.track import Branch, Track
from mixpose.tracking.tracker import Tracker, judged_again, weighed_at
from mixpose.tracking.twin import with_second

Starts: TypeAlias = tuple[Start, ...]


@dataclass(frozen=True, eq=False)
class Explanation:
    """What one body makes of what is left of a frame for it."""

    frame: Frame
    left: Mask  # (D,), see `Claims.left`
    ranked: Sequence[ScoredPose]  # distinct poses, the most evident first
    rest: SeenTogether = SeenTogether()  # what no body has
    told: Verdict | None = None  # `alone`, where it is at hand

    @cached_property
    def alone(self) -> Verdict:
        """The decision without `rest`."""
        return self.told or decided(self.frame, self.ranked)

    @cached_property
    def verdict(self) -> Verdict:
        """The decision about the frame, and why it is in doubt."""
        return with_second(self.alone, self.frame, self.rest)


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
    looked: bool = False  # whether they were looked for among points that cameras see together
    # where points in space may show bodies that have claimed nothing
    shown: dict[int, Starts] = field(default_factory=dict)
    # what explanations meet, and whose detections are by what `claimed` bodies meet
    met: dict[int, tuple[Explanation, Met]] = field(default_factory=dict)
    taken: tuple[Mapping[int, Met], Claims | None] = field(default=({}, None))

    def explained(self) -> dict[int, Explanation]:
        """The poses of all bodies."""
        self._all_from(self._expected())
        if len(self.claimed) < len(self.bodies):
            self._all_from(starts := self._found_at_once())
            waiting = [k for k in starts if k not in self.claimed]
            self.shown = {k: starts[k] for k in waiting if self._is_possible(k)}
        away = [k for k in range(len(self.bodies)) if k not in self.claimed]
        for is_forgotten in (False, True):
            self._on_the_rest([k for k in away if self._is_forgotten(k) == is_forgotten])
        self._judge_again()
        rest = self._rest()
        # what looks like one of identical bodies may be that of them which is not found
        lacking = {id(one.body) for k, one in enumerate(self.bodies) if k not in self.claimed}
        told = [(k, self.found[k]) for k in self.claimed if id(self.bodies[k].body) not in lacking]
        return self.found | {k: replace(one, rest=rest, told=one.alone) for k, one in told}

    def _expected(self) -> dict[int, Starts]:
        """Where bodies are expected to within their own size: farther off there may be others."""
        starts = dict[int, Starts]()
        for k, track in enumerate(self.tracks):
            if track.branches and not track.misses and not track.doubted:
                first = self.bodies[k].predictions(track, self.frame, self.time_s)[0]
                if first.uncertainty[:3].max() < self.bodies[k].body.radius:
                    starts[k] = (Start(first.T_world_object, first.uncertainty, first),)
        return starts

    def _found_at_once(self) -> dict[int, Starts]:
        """Where points in space put bodies that have claimed nothing yet, and rivals of that.

        Of each kind as many as there are, given to those that were nearest.
        """
        waiting = [k for k in range(len(self.bodies)) if k not in self.claimed]
        kinds = list({id(self.bodies[k].body): self.bodies[k] for k in waiting}.values())
        if self._shared is None or any(view.sensor.dimension != 2 for view in self.views):
            return {}
        rest, bodies = self._rest(), [one.body for one in kinds]
        self.looked = len(rest.views) > 1
        groups = [[k for k in waiting if self.bodies[k].body is body] for body in bodies]
        data = {k: self._frame(k, self._nobody.left(k)) for k in waiting}

        def known(kind: int, poses: Floats) -> Floats:
            """What the likeliest of identical bodies lets expect."""
            return np.asarray(np.max([data[k].gains(poses) for k in groups[kind]], axis=0))

        copies = search_copies(rest, bodies, kinds[0].free, known)
        found = dict[int, Starts]()
        for number, group in enumerate(groups):
            some = [one for one in copies if one.kind == number]
            frames = [data[k] for k in group]
            evidence = np.array([one.evidence for one in some])
            there = np.reshape([one.T_world_object for one in some], (-1, 4, 4))
            likely = np.array([evidence + one.expectation(there) for one in frames])
            for i, j in zip(*linear_sum_assignment(likely, maximize=True), strict=True):
                poses = some[j].T_world_object, some[j].rival
                found[group[i]] = tuple([Start(T, frames[i].close) for T in poses if T is not None])
        return found

    def _all_from(self, starts: Mapping[int, Starts]) -> None:
        """Bodies that are at some poses, all at once, until nothing changes hands."""
        places = {k: self._features(k, own[0]) for k, own in starts.items()}
        before = self.claimed
        some, claims = list(places), self._claims().expected(places, self.rules.gate)
        for _ in range(3):  # neighbours' neighbours are settled by then
            self.found |= self._at_once({k: starts[k] for k in some}, claims, places)
            self.claimed = before + [
                k
                for k, one in self.found.items()
                if k not in before and is_there(one.frame, one.ranked)
            ]
            claims = self._claims()
            changed = {k: self.found[k].left ^ claims.left(k) for k in self.claimed}
            some = [
                k
                for k, mask in changed.items()
                if k in starts
                and self._are_near(k, mask, self._features(k, self.found[k].ranked[0]))
            ]
            if not some:
                break

    def _at_once(
        self, starts: Mapping[int, Starts], claims: Claims, places: Mapping[int, Floats]
    ) -> dict[int, Explanation]:
        """Bodies around their starts, by what others leave.

        Those that nothing of the others' is near to see all that is there, and climb together.
        """
        left = {k: claims.left(k) for k in starts}
        frames = {k: self._frame(k, left[k], starts=starts[k]) for k in starts}
        alike, ends = list[int](), dict[int, Ascent]()
        if len(starts) > 1 and self._shared:
            whole = len(self._shared.totals)
            alike = [k for k, one in frames.items() if len(one.views) == whole and not one.is_timed]
            apart = [k for k in alike if not self._are_near(k, ~left[k], places[k])]
            climbed, ends = climbed_together({k: frames[k] for k in apart}, self._shared)
            frames |= climbed
        near = [k for k, one in frames.items() if k in ends or self._is_near(one, starts[k][0])]
        frames |= begun_together({k: frames[k] for k in alike if k in near}, ends)
        found = dict[int, Explanation]()
        for k, one in frames.items():
            ranked = self.bodies[k].explain(one, quickly=True) if k in near else []
            found[k] = Explanation(one, left[k], ranked)
        return found

    def _is_near(self, data: Frame, start: Start) -> bool:
        """Whether a fit may begin at σ_ε; from farther off, points in space lead there."""
        if self._shared is None or len(data.views) < 2:
            return True
        values = data.finest.value(start.T_world_object[None])
        return bool(values[0] >= data.rules.fit.near * len(data.views))

    def _is_possible(self, k: int) -> bool:
        """Whether the most evident pose of a body is worth telling."""
        free = self.found[k].frame.free
        return any(is_possible(best, free) for best in self.found[k].ranked[:1])

    def _on_the_rest(self, waiting: list[int]) -> None:
        """Bodies that are not where they are expected, on what is left, the most evident first."""
        self._look(waiting)
        while possible := [k for k in waiting if self._is_possible(k)]:
            winner = max(possible, key=lambda k: self.found[k].ranked[0].log_evidence)
            self.claimed.append(winner)
            waiting = [k for k in waiting if k != winner]
            # those that may have wanted the same, or are expected beside it
            label, taken = self.bodies[winner].label, self._met(winner)[0]
            self._look(
                [
                    k
                    for k in waiting
                    if label in self.tracks[k].companions
                    or (self.found[k].ranked and np.isin(self._met(k)[0], taken).any())
                ]
            )

    def _look(self, some: Iterable[int]) -> None:
        """By all proposers, on what is left; identical bodies that are forgotten look as one."""
        claims, twins = self._claims(), dict[int, Explanation]()
        for k in some:
            body, track, left = self.bodies[k].body, self.tracks[k], claims.left(k)
            if self.bodies[k].instance is None or not self._is_forgotten(k):
                self.found[k] = self._everywhere(k, left, track)
            else:
                if id(body) not in twins:
                    twins[id(body)] = self._everywhere(k, left, replace(track, branches=()))
                own = self._frame(k, left, searches=twins[id(body)].frame.searches)
                self.found[k] = replace(twins[id(body)], frame=own)

    def _everywhere(self, k: int, left: Mask, track: Track) -> Explanation:
        """A body by all proposers; one that is away is not searched for thoroughly each time."""
        data = self._frame(k, left, track, beside=self._companion(k))
        coasting = self.bodies[k].rules.motion.coasting
        # bodies that are there are not held up: others in turn, what nobody saw yet the seldomer
        # the longer that lasts
        is_new, often = not self.tracks[k].branches, self.rules.thorough
        if is_new:
            often = min(often, 1 + track.misses // coasting)
        is_due = (is_new or track.misses >= coasting) and (track.misses + k) % often == 0
        is_due |= not track.misses and self._is_forgotten(k)  # it went on, and nobody looked
        if self.claimed and (self.looked or (not is_due and track.misses > coasting)):
            data = replace(data, options=replace(data.options, search="live"))
        if not self.looked or is_due:
            return Explanation(data, left, self.bodies[k].explain(data))
        # points in space were looked at: about where it must be, if it was there just now
        around = predicted(data, [])
        near = tuple(one for one in around if not track.misses or self._is_near(data, one))
        found = self._from(k, data, near, left)
        if is_there(found.frame, found.ranked):
            return found
        return _as_rivals(found, self._from(k, data, self._shown_of(k), left))

    def _from(self, k: int, data: Frame, starts: Starts, left: Mask) -> Explanation:
        """A body from some starts, quickly; nothing without any."""
        data = replace(data, starts=starts)
        ranked = self.bodies[k].explain(data, quickly=True) if starts else []
        return Explanation(data, left, ranked)

    def _shown_of(self, k: int) -> Starts:
        """Where points in space may show a body, or one of identical bodies that look as one."""
        if self.bodies[k].instance is None or not self._is_forgotten(k):
            return self.shown.get(k, ())
        alike = [j for j in self.shown if self.bodies[j].body is self.bodies[k].body]
        return tuple([one for j in alike if self._is_forgotten(j) for one in self.shown[j]])

    def _judge_again(self) -> None:
        """Judge poses for which other detections are left by now; without merged ones, fit them."""
        places = {k: self._features(k, self.found[k].ranked[0]) for k in self.claimed}
        met = {k: self._met(k) for k in self.claimed}
        claims = self._nobody.taken(met).without_merged(met, places, self.rules)
        are_fitted = -2 in claims.owners
        for k, one in self.found.items():
            beside, changed = one.frame.beside, one.left ^ (left := claims.left(k))
            is_changed = bool(changed.any())
            if k in places and one.verdict.status == "ok":
                # what is gone from around a body makes clutter a little less likely
                is_changed = is_changed and self._are_near(k, changed, places[k])
            elif beside is None and one.frame.is_found_at_once:
                # bodies that were found at once tell where each other is
                beside = self._companion(k)
            if is_changed or beside is not one.frame.beside:
                data = self._frame(k, left, beside=beside, searches=one.frame.searches)
                data = weighed_at(data, one.ranked[0]) if one.ranked else data
                self.found[k] = Explanation(
                    data, left, judged_again(data, one.ranked, fitted=are_fitted)
                )

    def _companion(self, k: int) -> Branch | None:
        """Where the body is expected beside that sure one which tells most."""
        body, rules = self.bodies[k].body, self.bodies[k].rules.motion
        known = self.tracks[k].companions
        told = [
            known[label].expected(self.found[j].ranked[0].T_world_object, body, rules)
            for j in self.claimed
            if (label := self.bodies[j].label) in known and self.found[j].verdict.status == "ok"
        ]
        # the one that leaves the least volume
        return min(told, key=lambda one: float(np.log(one.uncertainty).sum()), default=None)

    def _frame(self, k: int, left: Mask, track: Track | None = None, **known: Any) -> Frame:
        """What is left of the frame for a body, and what is known before it."""
        track, views = track or self.tracks[k], self._nobody.part(left)
        return replace(self.bodies[k].data(track, self.frame, self.time_s, views), **known)

    @cached_property
    def _nobody(self) -> Claims:
        return Claims.none(self.views)

    def _claims(self) -> Claims:
        """Whose each detection is by now."""
        met, (before, claims) = {k: self._met(k) for k in self.claimed}, self.taken
        if claims is None or list(map(id, before.values())) != list(map(id, met.values())):
            claims = self._nobody.taken(met)
            self.taken = met, claims
        return claims

    def _rest(self) -> SeenTogether:
        """What no body has by now."""
        left, rules = self._nobody.part(self._claims().left(-1)), self.bodies[0].rules
        seen = [view for view in left if not view.observation.is_empty]
        return SeenTogether(seen, rules.judgement, rules.search)

    def _met(self, k: int) -> Met:
        """What the most evident pose of a body meets; of each explanation once."""
        found, (one, met) = self.found[k], self.met.get(k, (None, None))
        if met is None or one is not found:
            met = self._nobody.met_by(found.ranked[0], found.left)
            self.met[k] = found, met
        return met

    @cached_property
    def _shared(self) -> SharedDensities | None:
        """The densities of all that is seen; None of nothing, or without single detections."""
        seen = [view for view in self.views if not view.observation.is_empty]
        are_single = all(view.observation.points is not None for view in seen)
        return SharedDensities(seen) if seen and are_single else None

    def _is_forgotten(self, k: int) -> bool:
        """Whether where the body was says nothing any more: no velocity is believed then."""
        track, rules = self.tracks[k], self.bodies[k].rules.motion
        seconds = track.seconds_until(self.time_s) or 0.0
        is_long = track.misses > rules.coasting or seconds > rules.longest_s
        return not track.branches or is_long

    def _features(self, k: int, pose: Start | ScoredPose) -> Floats:
        return self._nobody.features(self.bodies[k].body, pose.T_world_object)

    def _are_near(self, k: int, chosen: Mask, places: Floats) -> bool:
        """Whether detections (D,) pull at features of body k that are at places (n, 3)."""
        reach = self.bodies[k].rules.judgement.noise.errors.reach
        return bool((cdist(self._nobody.places[chosen], places) < reach).any())


def _as_rivals(one: Explanation, other: Explanation) -> Explanation:
    """The poses of two explanations of a frame, in the frame of the likelier one."""
    if not (one.ranked and other.ranked):
        return one if one.ranked else other
    is_other = other.ranked[0].log_density >= one.ranked[0].log_density
    data, ranked = (other if is_other else one).frame, list(one.ranked)
    for pose in other.ranked:
        insert(ranked, pose, data.body, data.free, data.rules.acceptance)
    return Explanation(data, one.left, ranked)


def climbed_together(
    frames: Mapping[int, Frame], shared: SharedDensities
) -> tuple[dict[int, Frame], dict[int, Ascent]]:
    """The frames of several bodies, and what climbs from their first starts, where that is near.

    `shared` has all that their sensors see; what is not a body's own is out of its reach.
    """
    begun = {
        k: replace(one, drawn=matched_objective(one.views, one.body, one.sigmas, shared=shared))
        for k, one in frames.items()
    }
    some = {
        k: one
        for k, one in begun.items()
        if one.options.objective == "matched" and has_bare_points(one.body)
    }
    if len(some) < 2:
        return begun, {}
    first, poses = begun[min(some)], [one.starts[0].T_world_object for one in some.values()]
    climbs = fit_together([one.finest for one in some.values()], poses, first.free, first.rules.fit)
    found = {k: end for k, end in zip(some, climbs, strict=True) if end is not None}
    begun |= {k: replace(begun[k], drawn=objective) for k, (objective, _) in found.items()}
    return begun, {k: ascent for k, (_, ascent) in found.items()}


def begun_together(frames: Mapping[int, Frame], ends: Mapping[int, Ascent]) -> dict[int, Frame]:
    """The frames of bodies that the same sensors see, fitted from their first starts and judged.

    From where these climbs ended, if they are at hand.
    """
    starts, fits, cases = dict[int, Start](), dict[int, Fit](), list[Case]()
    for k, one in frames.items():
        likelihood, starts[k] = likelihood_of(one), one.starts[0]
        if isinstance(likelihood, MatchedLikelihood):
            fits[k] = likelihood.fit(starts[k], ends.get(k))
            cases.append(case_of(one, fits[k], starts[k]))
    if not fits:
        return {}
    first = frames[min(fits)]
    poses = judge_together(cases, first.free, first.rules.judgement)
    return {
        k: replace(frames[k], together=(starts[k], fit, pose))
        for (k, fit), pose in zip(fits.items(), poses, strict=True)
    }

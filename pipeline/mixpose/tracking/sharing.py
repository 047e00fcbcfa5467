"""Explain one frame by several bodies: each by the detections that the others leave unclaimed.

Bodies where they are expected come first, all at once, and claim the detections that they meet.
The others are sought among unclaimed detections: the most evident one, whatever its place in the
session file, claims its detections, and bodies that had met any of these are sought again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mixpose.fit import Fit, fit_together
from mixpose.judgement import Case, ScoredPose, Verdict, insert, is_possible, judge_together
from mixpose.objective import SharedDensities, View, has_bare_points, matched_objective
from mixpose.optimise import Ascent
from mixpose.records import Floats, Mask, replace
from mixpose.search import SeenTogether, search_copies
from mixpose.tracking.claims import Claims, Met
from mixpose.tracking.doubt import decide_frame
from mixpose.tracking.frame import Frame, Start, gains_by, log_densities_by
from mixpose.tracking.likelihood import MatchedLikelihood, case_of, likelihood_of
from mixpose.tracking.proposers import is_convincing, predicted
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.track import Branch, Track
from mixpose.tracking.tracker import Tracker, judge_again, weighed_at
from mixpose.tracking.twin import with_second

Starts: TypeAlias = tuple[Start, ...]


@dataclass(frozen=True, eq=False)
class Explanation:
    """The poses of one body by the detections that other bodies leave."""

    frame: Frame
    unclaimed: Mask  # (D,), see `Claims.available`
    ranked: Sequence[ScoredPose]  # distinct poses, the most evident first
    leftover: SeenTogether = SeenTogether()  # detections that no body claims
    precomputed: Verdict | None = None  # `alone`, if known

    @cached_property
    def alone(self) -> Verdict:
        """Return the decision without `leftover`."""
        return self.precomputed or decide_frame(self.frame, self.ranked)

    @cached_property
    def verdict(self) -> Verdict:
        """Return the decision, in doubt where `leftover` shows the body a second time."""
        return with_second(self.alone, self.frame, self.leftover)


@dataclass
class Sharing:
    """The explanations of one frame by its bodies; each step changes `explained` and `claimed`."""

    bodies: Sequence[Tracker]
    tracks: Sequence[Track]
    frame: int
    time_s: float | None
    views: Sequence[View]  # of all sensors that had a frame
    rules: SceneRules
    explained: dict[int, Explanation] = field(default_factory=dict)  # by body
    claimed: list[int] = field(default_factory=list)  # bodies that own the detections they meet
    points_searched: bool = False  # whether triangulated points were searched
    # starts at triangulated points for bodies without claims
    point_starts: dict[int, Starts] = field(default_factory=dict)
    # caches of `_met` and `_claims`
    met: dict[int, tuple[Explanation, Met]] = field(default_factory=dict)
    cached_claims: tuple[Mapping[int, Met], Claims | None] = field(default=({}, None))

    def explain_all(self) -> dict[int, Explanation]:
        """Return the explanation of every body."""
        self._fit_together(self._expected_starts())
        if len(self.claimed) < len(self.bodies):
            self._fit_together(starts := self._triangulated_starts())
            waiting = [k for k in starts if k not in self.claimed]
            self.point_starts = {k: starts[k] for k in waiting if self._is_possible(k)}
        missing = [k for k in range(len(self.bodies)) if k not in self.claimed]
        for is_forgotten in (False, True):
            self._fit_unclaimed([k for k in missing if self._is_forgotten(k) == is_forgotten])
        self._judge_again()
        leftover = self._leftover()
        # a second pose may be a missing body of the same kind, and casts no doubt then
        kinds = [id(tracker.body) for tracker in self.bodies]
        lacking = {kind for k, kind in enumerate(kinds) if k not in self.claimed}
        clear = {k: self.explained[k] for k in self.claimed if kinds[k] not in lacking}
        return self.explained | {
            k: replace(old, leftover=leftover, precomputed=old.alone) for k, old in clear.items()
        }

    def _expected_starts(self) -> dict[int, Starts]:
        """Return starts at predictions that are sure to within the body's size."""
        starts = dict[int, Starts]()
        for k, track in enumerate(self.tracks):
            if track.branches and not track.misses and not track.doubted:
                first = self.bodies[k].predictions(track, self.frame, self.time_s)[0]
                if first.uncertainty[:3].max() < self.bodies[k].body.radius:
                    starts[k] = (Start(first.T_world_object, first.uncertainty, first),)
        return starts

    def _triangulated_starts(self) -> dict[int, Starts]:
        """Return starts at triangulated points for bodies without claims, and their rivals."""
        waiting = [k for k in range(len(self.bodies)) if k not in self.claimed]
        kinds = list({id(self.bodies[k].body): self.bodies[k] for k in waiting}.values())
        if self._shared is None or any(view.sensor.dimension != 2 for view in self.views):
            return {}
        leftover, bodies = self._leftover(), [tracker.body for tracker in kinds]
        self.points_searched = len(leftover.views) > 1
        groups = [[k for k in waiting if self.bodies[k].body is body] for body in bodies]
        data = {k: self._frame(k, self._no_claims.available(k)) for k in waiting}

        def gain(kind: int, poses: Floats) -> Floats:
            """Return the gain (K,) of poses by the likeliest of identical bodies."""
            return np.asarray(gains_by([data[k] for k in groups[kind]], poses).max(axis=0))

        copies = search_copies(leftover, bodies, kinds[0].free, gain)
        starts = dict[int, Starts]()
        for number, group in enumerate(groups):
            candidates = [copy for copy in copies if copy.kind == number]
            frames = [data[k] for k in group]
            evidence = np.array([copy.evidence for copy in candidates])
            poses = np.reshape([copy.T_world_object for copy in candidates], (-1, 4, 4))
            likely = evidence + log_densities_by(frames, poses)
            for i, j in zip(*linear_sum_assignment(likely, maximize=True), strict=True):
                copy, wide = candidates[j], frames[i].close_uncertainty
                both = copy.T_world_object, copy.rival
                starts[group[i]] = tuple([Start(T, wide) for T in both if T is not None])
        return starts

    def _fit_together(self, starts: Mapping[int, Starts]) -> None:
        """Fit bodies from given starts together, until no detection changes its owner."""
        places = {k: self._features(k, first[0]) for k, first in starts.items()}
        before = self.claimed
        changing, claims = list(places), self._claims().expected(places, self.rules.gate)
        for _ in range(3):  # after that even neighbours of neighbours change no more
            self.explained |= self._fit_once({k: starts[k] for k in changing}, claims, places)
            self.claimed = before + [
                k
                for k, explanation in self.explained.items()
                if k not in before and is_convincing(explanation.frame, explanation.ranked)
            ]
            claims = self._claims()
            changed = {k: self.explained[k].unclaimed ^ claims.available(k) for k in self.claimed}
            changing = [
                k
                for k, mask in changed.items()
                if k in starts
                and self._are_near(k, mask, self._features(k, self.explained[k].ranked[0]))
            ]
            if not changing:
                break

    def _fit_once(
        self, starts: Mapping[int, Starts], claims: Claims, places: Mapping[int, Floats]
    ) -> dict[int, Explanation]:
        """Explain bodies near their starts by the detections that others leave.

        Bodies without detections of others nearby see all detections, and climb together.
        """
        available = {k: claims.available(k) for k in starts}
        frames = {k: self._frame(k, available[k], starts=starts[k]) for k in starts}
        whole, ends = list[int](), dict[int, Ascent]()
        if len(starts) > 1 and self._shared:
            count = len(self._shared.totals)
            whole = [
                k for k, data in frames.items() if len(data.views) == count and not data.is_timed
            ]
            apart = [k for k in whole if not self._are_near(k, ~available[k], places[k])]
            climbed, ends = climb_together({k: frames[k] for k in apart}, self._shared)
            frames |= climbed
        near = [k for k, data in frames.items() if k in ends or self._is_near(data, starts[k][0])]
        frames |= fit_jointly({k: frames[k] for k in whole if k in near}, ends)
        explained = dict[int, Explanation]()
        for k, data in frames.items():
            ranked = self.bodies[k].explain(data, quickly=True) if k in near else []
            explained[k] = Explanation(data, available[k], ranked)
        return explained

    def _is_near(self, data: Frame, start: Start) -> bool:
        """Test whether a fit may begin at σ_ε; triangulated points lead there from farther off."""
        if self._shared is None or len(data.views) < 2:
            return True
        values = data.finest.value(start.T_world_object[None])
        return bool(values[0] >= data.rules.fit.near * len(data.views))

    def _is_possible(self, k: int) -> bool:
        """Test whether the most evident pose of a body is worth reporting."""
        free = self.explained[k].frame.free
        return any(is_possible(best, free) for best in self.explained[k].ranked[:1])

    def _fit_unclaimed(self, waiting: list[int]) -> None:
        """Fit bodies that are elsewhere to unclaimed detections, the most evident first."""
        self._search(waiting)
        while possible := [k for k in waiting if self._is_possible(k)]:
            winner = max(possible, key=lambda k: self.explained[k].ranked[0].log_evidence)
            self.claimed.append(winner)
            waiting = [k for k in waiting if k != winner]
            # bodies that met the same detections, or are expected beside the winner
            label, claimed = self.bodies[winner].label, self._met(winner)[0]
            self._search(
                [
                    k
                    for k in waiting
                    if label in self.tracks[k].companions
                    or (self.explained[k].ranked and np.isin(self._met(k)[0], claimed).any())
                ]
            )

    def _search(self, waiting: Iterable[int]) -> None:
        """Explain bodies by all proposers; forgotten identical bodies are sought as one."""
        claims, shared = self._claims(), dict[int, Explanation]()
        for k in waiting:
            body, track, available = self.bodies[k].body, self.tracks[k], claims.available(k)
            if self.bodies[k].instance is None or not self._is_forgotten(k):
                self.explained[k] = self._explain(k, available, track)
            else:
                if id(body) not in shared:
                    shared[id(body)] = self._explain(k, available, replace(track, branches=()))
                data = self._frame(k, available, searches=shared[id(body)].frame.searches)
                self.explained[k] = replace(shared[id(body)], frame=data)

    def _explain(self, k: int, available: Mask, track: Track) -> Explanation:
        """Explain a body by all proposers; a missing one is searched thoroughly only in turn."""
        data = self._frame(k, available, track, companion_prediction=self._companion_prediction(k))
        coasting = self.bodies[k].rules.motion.coasting
        # missing bodies take turns, so that present ones need not wait; a body never seen so far
        # is searched less and less often
        is_new, often = not self.tracks[k].branches, self.rules.thorough
        if is_new:
            often = min(often, 1 + track.misses // coasting)
        is_due = (is_new or track.misses >= coasting) and (track.misses + k) % often == 0
        is_due |= not track.misses and self._is_forgotten(k)  # it moved on unobserved
        if self.claimed and (self.points_searched or (not is_due and track.misses > coasting)):
            data = replace(data, options=replace(data.options, search="live"))
        if not self.points_searched or is_due:
            return Explanation(data, available, self.bodies[k].explain(data))
        # triangulated points were searched; a body seen just now must be near its prediction
        around = predicted(data, [])
        near = tuple(start for start in around if not track.misses or self._is_near(data, start))
        expected = self._explain_from(k, data, near, available)
        if is_convincing(expected.frame, expected.ranked):
            return expected
        return _merged(expected, self._explain_from(k, data, self._point_starts_of(k), available))

    def _explain_from(self, k: int, data: Frame, starts: Starts, available: Mask) -> Explanation:
        """Explain a body quickly from some starts; no poses without any."""
        data = replace(data, starts=starts)
        ranked = self.bodies[k].explain(data, quickly=True) if starts else []
        return Explanation(data, available, ranked)

    def _point_starts_of(self, k: int) -> Starts:
        """Return triangulated starts of a body, or of all forgotten ones of its kind."""
        if self.bodies[k].instance is None or not self._is_forgotten(k):
            return self.point_starts.get(k, ())
        alike = [j for j in self.point_starts if self.bodies[j].body is self.bodies[k].body]
        return sum((self.point_starts[j] for j in alike if self._is_forgotten(j)), ())

    def _judge_again(self) -> None:
        """Judge poses again if their available detections changed; fit them after merged ones."""
        places = {k: self._features(k, self.explained[k].ranked[0]) for k in self.claimed}
        met = {k: self._met(k) for k in self.claimed}
        claims = self._no_claims.claimed_by(met).without_merged(met, places, self.rules)
        are_fitted = -2 in claims.owners
        for k, old in self.explained.items():
            companion, available = old.frame.companion_prediction, claims.available(k)
            changed = old.unclaimed ^ available
            is_changed = bool(changed.any())
            if k in places and old.verdict.status == "ok":
                # detections gone far from a body only make clutter a little less likely
                is_changed = is_changed and self._are_near(k, changed, places[k])
            elif companion is None and old.frame.has_triangulated_start:
                # bodies found at the same time predict each other
                companion = self._companion_prediction(k)
            if is_changed or companion is not old.frame.companion_prediction:
                data = self._frame(k, available, companion_prediction=companion)
                data = replace(data, searches=old.frame.searches)
                data = weighed_at(data, old.ranked[0]) if old.ranked else data
                ranked = judge_again(data, old.ranked, fitted=are_fitted)
                self.explained[k] = Explanation(data, available, ranked)

    def _companion_prediction(self, k: int) -> Branch | None:
        """Return the prediction of least volume beside any sure body."""
        body, rules = self.bodies[k].body, self.bodies[k].rules.motion
        known = self.tracks[k].companions
        predictions = [
            known[label].expected(self.explained[j].ranked[0].T_world_object, body, rules)
            for j in self.claimed
            if (label := self.bodies[j].label) in known and self.explained[j].verdict.status == "ok"
        ]
        volumes = [float(np.log(branch.uncertainty).sum()) for branch in predictions]
        return predictions[int(np.argmin(volumes))] if predictions else None

    def _frame(self, k: int, available: Mask, track: Track | None = None, **known: Any) -> Frame:
        """Build the frame of one body from the available detections and its track."""
        track, views = track or self.tracks[k], self._no_claims.views_with(available)
        return replace(self.bodies[k].data(track, self.frame, self.time_s, views), **known)

    @cached_property
    def _no_claims(self) -> Claims:
        return Claims.none(self.views)

    def _claims(self) -> Claims:
        """Return the owner of each detection, by what `claimed` bodies meet."""
        met, (before, claims) = {k: self._met(k) for k in self.claimed}, self.cached_claims
        if claims is None or list(map(id, before.values())) != list(map(id, met.values())):
            claims = self._no_claims.claimed_by(met)
            self.cached_claims = met, claims
        return claims

    def _leftover(self) -> SeenTogether:
        """Return the detections that no body claims."""
        views = self._no_claims.views_with(self._claims().available(-1))
        seen = [view for view in views if not view.observation.is_empty]
        rules = self.bodies[0].rules
        return SeenTogether(seen, rules.judgement, rules.search)

    def _met(self, k: int) -> Met:
        """Return the detections that the most evident pose of a body meets."""
        explanation, (cached, met) = self.explained[k], self.met.get(k, (None, None))
        if met is None or cached is not explanation:
            met = self._no_claims.met_by(explanation.ranked[0], explanation.unclaimed)
            self.met[k] = explanation, met
        return met

    @cached_property
    def _shared(self) -> SharedDensities | None:
        """Return the densities of all views with detections, or None for grey values."""
        seen = [view for view in self.views if not view.observation.is_empty]
        are_single = all(view.observation.points is not None for view in seen)
        return SharedDensities(seen) if seen and are_single else None

    def _is_forgotten(self, k: int) -> bool:
        """Test whether a body was last seen too long ago to believe a velocity, or never."""
        track, rules = self.tracks[k], self.bodies[k].rules.motion
        seconds = track.seconds_until(self.time_s) or 0.0
        is_long = track.misses > rules.coasting or seconds > rules.longest_s
        return not track.branches or is_long

    def _features(self, k: int, pose: Start | ScoredPose) -> Floats:
        return self._no_claims.features(self.bodies[k].body, pose.T_world_object)

    def _are_near(self, k: int, detections: Mask, places: Floats) -> bool:
        """Test whether some detections (D,) pull at features of body k at places (n, 3)."""
        reach = self.bodies[k].rules.judgement.noise.errors.reach
        return bool((cdist(self._no_claims.places[detections], places) < reach).any())


def _merged(first: Explanation, second: Explanation) -> Explanation:
    """Merge the poses of two explanations into the frame of the likelier one."""
    if not (first.ranked and second.ranked):
        return first if first.ranked else second
    is_second = second.ranked[0].log_density >= first.ranked[0].log_density
    data, ranked = (second if is_second else first).frame, list(first.ranked)
    for pose in second.ranked:
        insert(ranked, pose, data.body, data.free, data.rules.acceptance)
    return Explanation(data, first.unclaimed, ranked)


def climb_together(
    frames: Mapping[int, Frame], shared: SharedDensities
) -> tuple[dict[int, Frame], dict[int, Ascent]]:
    """Climb from the first starts of several bodies at once where these are near.

    Return frames with `precomputed` objectives, and the ascents.  `shared` has all detections.
    """
    drawn = dict(frames)
    for k, data in frames.items():
        objective = matched_objective(data.views, data.body, data.sigmas, shared=shared)
        drawn[k] = replace(data, precomputed=objective)
    matched = {
        k: data
        for k, data in drawn.items()
        if data.options.objective == "matched" and has_bare_points(data.body)
    }
    if len(matched) < 2:
        return drawn, {}
    first, poses = drawn[min(matched)], [data.starts[0].T_world_object for data in matched.values()]
    ends = fit_together([d.finest for d in matched.values()], poses, first.free, first.rules.fit)
    climbs = {k: end for k, end in zip(matched, ends, strict=True) if end is not None}
    drawn |= {k: replace(drawn[k], precomputed=objective) for k, (objective, _) in climbs.items()}
    return drawn, {k: ascent for k, (_, ascent) in climbs.items()}


def fit_jointly(frames: Mapping[int, Frame], ends: Mapping[int, Ascent]) -> dict[int, Frame]:
    """Return frames with `joint_fit`: a fit from the first start, or from where its climb ended."""
    starts, fits, cases = dict[int, Start](), dict[int, Fit](), list[Case]()
    for k, frame in frames.items():
        likelihood, starts[k] = likelihood_of(frame), frame.starts[0]
        if isinstance(likelihood, MatchedLikelihood):
            fits[k] = likelihood.fit(starts[k], ends.get(k))
            cases.append(case_of(frame, fits[k], starts[k]))
    if not fits:
        return {}
    first = frames[min(fits)]
    poses = judge_together(cases, first.free, first.rules.judgement)
    return {
        k: replace(frames[k], joint_fit=(starts[k], fit, pose))
        for (k, fit), pose in zip(fits.items(), poses, strict=True)
    }

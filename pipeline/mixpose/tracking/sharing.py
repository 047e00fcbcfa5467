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

import numpy as np
from numpy.typing import NDArray

from mixpose.objective import SharedDensities, View, project_body
from mixpose.records import Floats, PointPattern
from mixpose.tracking.claims import (
    MERGED,
    Claims,
    Owners,
    Places,
    Unclaimed,
    expected_owners,
    hides_near,
    is_changed,
    is_reached,
    left_for,
    merged_spots,
    nobody,
    overlap,
    owners_of,
    unmet_places,
)
from mixpose.tracking.explain import Explanation, explain, explain_by
from mixpose.tracking.frame import Frame
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.together import begun_together
from mixpose.tracking.track import Prediction, Track
from mixpose.tracking.tracked_body import TrackedBody


@dataclass(frozen=True, eq=False)
class Moment:
    """What is given of a frame of several bodies."""

    bodies: tuple[TrackedBody, ...]
    tracks: Sequence[Track]
    frame: int
    time_s: float | None
    views: tuple[View, ...]  # that saw anything
    sensors: int  # that had a frame
    rules: SceneRules

    @property
    def is_single(self) -> bool:
        """Whether there is no other body to share with."""
        return len(self.bodies) == 1

    @cached_property
    def shared(self) -> SharedDensities | None:
        """The densities of all that is seen; None where a sensor has no single detections."""
        if all(isinstance(view.observation.pattern, PointPattern) for view in self.views):
            return SharedDensities.drawn(self.views)
        return None

    def left(self, k: int, owners: Owners) -> Unclaimed:
        """What others leave for a body."""
        if self.is_single:
            return Unclaimed(self.views, {}, self.sensors)
        return left_for(k, self.views, owners, self.sensors)

    def data(self, k: int, left: Unclaimed, track: Track | None = None) -> Frame:
        """What is left of the frame for a body, and what is known before it."""
        return self.bodies[k].data(track or self.tracks[k], self.frame, self.time_s, left.views)

    def is_trusted(self, k: int) -> bool:
        """Whether a body is looked for where it is expected, before those that are not."""
        track = self.tracks[k]
        return bool(track.branches) and track.misses == 0 and not track.doubted

    def is_forgotten(self, k: int) -> bool:
        """Whether where the body was says nothing any more."""
        return not self.tracks[k].branches or self.tracks[k].misses > self.forgotten(k)

    def forgotten(self, k: int) -> int:
        """Frames without a pose after which a body is forgotten: no velocity is believed then."""
        return self.bodies[k].rules.motion.coasting

    def reach(self, k: int) -> float:
        """How far from features of body k, in σ_ε, detections pull."""
        return self.bodies[k].rules.judgement.noise.errors.reach

    def has_twin(self, k: int) -> bool:
        """Whether there are bodies that are identical to one."""
        return sum(other.body is self.bodies[k].body for other in self.bodies) > 1

    def places(self, k: int, T: Floats) -> dict[str, Floats]:
        """Where the sensors have the features of a body at a pose."""
        sensors = tuple(view.sensor for view in self.views)
        at = project_body(sensors, self.bodies[k].body).project(T[None])
        return {
            view.name: at.y[i, 0][at.seen[i, 0]][:, : view.sensor.dimension]
            for i, view in enumerate(self.views)
        }

    def expected_places(self, k: int) -> dict[str, Floats]:
        """Where the sensors have the features of a body that is where it is expected."""
        first = self.bodies[k].predictions(self.tracks[k], self.frame, self.time_s)[0]
        return self.places(k, first.T_world_object)


@dataclass(frozen=True, eq=False)
class Shares:
    """What the bodies of a moment explain so far, and who has which detections."""

    found: Mapping[int, Explanation] = field(default_factory=dict)  # by body
    claimed: tuple[int, ...] = ()  # bodies that have what their best poses meet
    merged: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)  # spots of two bodies

    @property
    def claims(self) -> dict[int, Claims]:
        """The detections of each body that has some."""
        return {k: self.found[k].claims for k in self.claimed}

    def owners(self, moment: Moment) -> Owners:
        """Owners of all detections."""
        if moment.is_single:
            return {}
        owners = owners_of(moment.views, self.claims)
        for name, numbers in self.merged.items():
            owners[name][numbers] = MERGED
        return owners

    def after(self, found: Mapping[int, Explanation]) -> Shares:
        """With other explanations of some bodies."""
        return replace(self, found={**self.found, **found})


def shared_out(moment: Moment) -> Shares:
    """The poses of all bodies of a moment."""
    shares = _where_expected(moment)
    away = [k for k in range(len(moment.bodies)) if k not in shares.claimed]
    shares = _on_the_rest(moment, shares, [k for k in away if not moment.is_forgotten(k)])
    shares = _on_the_rest(moment, shares, [k for k in away if moment.is_forgotten(k)])
    if moment.is_single:
        return shares
    shares = _without_merged(moment, shares)
    owners = shares.owners(moment)
    for k, one in shares.found.items():
        if is_changed(k, one.left, owners):
            shares = shares.after({k: _again(moment, one, k, moment.left(k, owners))})
    return _beside_others(moment, shares, away)


def _where_expected(moment: Moment) -> Shares:
    """Bodies that are where they are expected, all at once, until nothing changes hands."""
    trusted = [k for k in range(len(moment.bodies)) if moment.is_trusted(k)]
    shares, owners = Shares(), Shares().owners(moment)
    places: dict[int, dict[str, Floats]] = {}
    if not moment.is_single:
        places = {k: moment.expected_places(k) for k in trusted}
        owners = expected_owners(moment.views, places, moment.rules.gate)
    for _ in range(moment.rules.rounds):
        shares = shares.after(_at_once(moment, trusted, owners, places))
        sure = tuple(k for k, one in shares.found.items() if one.convinces)
        shares = replace(shares, claimed=sure)
        owners = shares.owners(moment)
        trusted = [k for k in sure if _is_touched(moment, k, shares.found[k], owners)]
        if not trusted:
            break
    return shares


def _at_once(
    moment: Moment, some: Sequence[int], owners: Owners, places: Mapping[int, Places]
) -> dict[int, Explanation]:
    """Bodies around their predictions, by what others leave.

    Those that nothing of the others' is near to look at all that is there, and are fitted together.
    """
    left = {k: moment.left(k, owners) for k in some}
    frames = {k: moment.data(k, left[k]) for k in some}
    alike = [
        k
        for k in some
        if len(some) > 1
        and len(frames[k].views) == len(moment.views)
        and moment.shared is not None
        and not hides_near(moment.views, left[k], places[k], moment.reach(k))
    ]
    if alike and moment.shared is not None:
        begun = begun_together([frames[k] for k in alike], moment.shared)
        frames.update(zip(alike, begun, strict=True))
    return {
        k: explain(moment.bodies[k], frames[k], left[k], quickly=not moment.is_single) for k in some
    }


def _is_touched(moment: Moment, k: int, one: Explanation, owners: Owners) -> bool:
    if not is_changed(k, one.left, owners):
        return False
    places = moment.places(k, one.ranked[0].T_world_object)
    return is_reached(k, moment.views, one.left, owners, places, moment.reach(k))


def _on_the_rest(moment: Moment, shares: Shares, waiting: list[int]) -> Shares:
    """Bodies that are not where they are expected, on what is left, the most evident first."""
    shares = shares.after(_everywhere(moment, shares, waiting)) if waiting else shares
    while possible := [k for k in waiting if shares.found[k].is_possible]:
        winner = _most_evident(moment, shares, possible)
        shares = replace(shares, claimed=(*shares.claimed, winner))
        waiting = [k for k in waiting if k != winner]
        taken = shares.found[winner].claims
        again = [
            k
            for k in waiting
            if shares.found[k].ranked and overlap(shares.found[k].claims, taken) > 0
        ]
        shares = shares.after(_everywhere(moment, shares, again))
        shares = _beside_others(moment, shares, [k for k in waiting if k not in again])
    return shares


def _everywhere(moment: Moment, shares: Shares, some: Iterable[int]) -> dict[int, Explanation]:
    """Everywhere, on what is left; identical bodies of which nothing is known look as one."""
    owners = shares.owners(moment)
    found: dict[int, Explanation] = {}
    seen: dict[int, Explanation] = {}
    for k in some:
        as_one = moment.is_forgotten(k) and moment.has_twin(k)
        twin = seen.get(id(moment.bodies[k].body)) if as_one else None
        if twin is None:
            found[k] = _look(moment, shares, k, moment.left(k, owners), as_one)
        else:
            whole = moment.data(k, moment.left(k, nobody(moment.views)))
            found[k] = replace(twin, tracked=moment.bodies[k], frame=whole)
        if as_one:
            seen[id(moment.bodies[k].body)] = found[k]
    return found


def _look(moment: Moment, shares: Shares, k: int, left: Unclaimed, as_one: bool) -> Explanation:
    """A body by all proposers, after those that were asked already where the same is left."""
    track, before, told = moment.tracks[k], shares.found.get(k), _companion(moment, shares, k)
    if before and told is before.frame.beside and _is_same(before.left, left):
        return explain(before.tracked, before.frame, left, before)
    data = moment.data(k, left, replace(track, branches=()) if as_one else track)
    data = replace(data, beside=told)
    rules = moment.rules
    is_away = track.misses > moment.forgotten(k) and track.misses % rules.thorough != 0
    if is_away and shares.claimed:  # bodies that are there are not held up
        data = replace(data, options=replace(data.options, search="live"))
    found = explain(moment.bodies[k], data, left)
    if as_one:
        own = replace(moment.data(k, left), beside=told, searches=data.searches)
        found = replace(found, frame=own)
    return found


def _is_same(a: Unclaimed, b: Unclaimed) -> bool:
    return all(np.array_equal(kept, b.kept[name]) for name, kept in a.kept.items())


def _again(
    moment: Moment, one: Explanation, k: int, left: Unclaimed, *, fitted: bool = False
) -> Explanation:
    """The poses of a body by what is left for it by now, and fitted to that."""
    data = replace(moment.data(k, left), beside=one.frame.beside, searches=one.frame.searches)
    return explain_by(moment.bodies[k], data, left, one.ranked, fitted=fitted)


def _without_merged(moment: Moment, shares: Shares) -> Shares:
    """Take from bodies what may be their feature and another's in one spot, and fit again."""
    unmet = {k: unmet_places(shares.found[k].ranked[0]) for k in shares.claimed}
    rules = moment.rules
    merged = merged_spots(moment.views, shares.claims, unmet, rules.touching, rules.pulled)
    shares = replace(shares, merged=merged)
    owners = shares.owners(moment) if merged else {}
    for k in shares.claimed if merged else ():
        if is_changed(k, shares.found[k].left, owners):
            again = _again(moment, shares.found[k], k, moment.left(k, owners), fitted=True)
            if again.ranked:
                shares = shares.after({k: again})
    return shares


def _beside_others(moment: Moment, shares: Shares, some: Iterable[int]) -> Shares:
    """Bodies that are not sure, by what was found beside them since they looked."""
    for k in some:
        one = shares.found[k]
        if not one.ranked or one.is_sure:
            continue
        told, before = _companion(moment, shares, k), one.frame.beside
        if told and (before is None or _width(told) < _width(before)):
            data = replace(one, frame=replace(one.frame, beside=told))
            shares = shares.after({k: _again(moment, data, k, one.left)})
    return shares


def _companion(moment: Moment, shares: Shares, k: int) -> Prediction | None:
    """Where the body is expected beside that sure one which tells most."""
    tracked, known, told = moment.bodies[k], moment.tracks[k].companions, []
    for j in shares.claimed:
        one = known.get(moment.bodies[j].label)
        if one is not None and shares.found[j].is_sure:
            T = shares.found[j].ranked[0].T_world_object
            told.append(Prediction(*one.expected(T, tracked.body, tracked.rules.motion), 1.0))
    return min(told, key=_width, default=None)


def _width(expected: Prediction) -> float:
    """How little a prediction tells: the logarithm of the volume that it leaves."""
    return float(np.log(expected.uncertainty).sum())


def _most_evident(moment: Moment, shares: Shares, possible: Sequence[int]) -> int:
    """The body that is believed next: with it, all that compete explain most."""
    found = shares.found
    first = max(possible, key=lambda k: found[k].evidence)
    for other in possible:
        same = moment.bodies[first].body is moment.bodies[other].body
        if other == first or (same and moment.is_forgotten(first) and moment.is_forgotten(other)):
            continue
        if overlap(found[first].claims, found[other].claims) < moment.rules.rival:
            continue
        if evidence_of_both(moment, shares, first, other) < evidence_of_both(
            moment, shares, other, first
        ):
            first = other
    return first


def evidence_of_both(moment: Moment, shares: Shares, keeps: int, other: int) -> float:
    """Evidence of two bodies, if the one keeps what it meets and the other has the rest.

    One that the rest says nothing for is taken to be away, which has the odds of clutter.
    """
    claimed = (*(k for k in shares.claimed if k != keeps), keeps)
    left = moment.left(other, replace(shares, claimed=claimed).owners(moment))
    rest = _again(moment, shares.found[other], other, left).ranked
    return shares.found[keeps].evidence + max([0.0, *(one.log_evidence for one in rest[:1])])

"""What a session would have to say for its frames to be explained.

A few frames are estimated by the session as it is and by each of its changes; a change is told by
which they are explained with far more evidence.  Changes without values are tried where frames are
not explained; values are fitted to the matches of all frames, those that promise most first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise, takewhile
from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from mixpose.body import of_points
from mixpose.checking import evidence
from mixpose.checking.changes import Change, by_cameras_alone, changes
from mixpose.checking.evidence import Explained, Frames, Views, best_pose, evidence_of
from mixpose.checking.rules import DiagnosisRules
from mixpose.checking.values import Adjustment, Unknown, adjusted, promise, unknowns
from mixpose.judgement import ScoredPose
from mixpose.records import Floats
from mixpose.session import Session

Otherwise: TypeAlias = Sequence[tuple[Change, Frames]]
"""Changes of how features are extracted, with the frames as they are found then."""

IN_A_ROW = 3
"""Frames by which a sensor is told to be late."""

_CLEARER = 0.5  # of what is met off: frames of other moments are met several times as far off


@dataclass(frozen=True)
class Diagnosis:
    """What a few frames say of a session."""

    # what is wrong, and with what change frames are explained; empty where nothing is
    change: str = ""
    gain: str = ""  # what is explained by it
    likeliest: Change | None = None  # of the changes that this may be
    # by the session as it is: how many frames are explained, of how many, and what is met off there
    good: int = 0
    count: int = 0
    rms: float = 0.0  # in sigma


@dataclass
class _Runner:
    """A change on its way through the frames."""

    change: Change
    frames: Frames
    poses: list[ScoredPose | None] = field(default_factory=list)

    def advance(self, session: Session, useful: float) -> int:
        """Try the next frame, for a pose of `useful` evidence; the guesses that took."""
        number, views = self.frames[len(self.poses)]
        body, seen = self.change.body(session.body), self.change.views(views)
        pose, made = best_pose(session, body, number, seen, DiagnosisRules().guesses, useful)
        self.poses.append(pose)
        return made

    def explains(self, rules: DiagnosisRules) -> bool:
        """Whether it explains the last frame."""
        pose = self.poses[-1]
        return pose is not None and evidence.is_explained(pose, rules)

    def gain(self, before: Explained) -> float:
        """Nats by which it explains the frames that it tried better."""
        return sum(evidence_of(a) - evidence_of(b) for a, b in zip(self.poses, before.poses))


@dataclass(frozen=True)
class _Case:
    """Frames of a session, and how they are explained as it is."""

    session: Session
    frames: Frames
    before: Explained


class Tried(NamedTuple):
    """A change, by which frames are explained so much better."""

    change: Change
    explained: Explained
    gain: float


def diagnosis(
    session: Session,
    frames: Frames,
    otherwise: Callable[[bool], Otherwise] = lambda _: (),
    further: Callable[[], Frames] = lambda: (),
) -> Diagnosis:
    """What is most likely wrong with a session of one body, by frames of its recording.

    Frames are by number, those that show most first. `otherwise` gives changes of how features are
    extracted, by whether any frame is explained as it is. `further` frames are looked at, too,
    where these leave a change by values undecided.
    """
    session, rules = evidence.anywhere(session), DiagnosisRules()
    before = _as_it_is(session, frames)
    case = _Case(session, frames[: len(before.poses)], before)
    frames = case.frames
    is_good = sum(evidence.is_well_explained(pose, rules) for pose in before.poses)
    tried = list[Tried]()
    if before.good(rules) < len(frames) or 2 * is_good < len(frames):
        tried += _without_values(case, otherwise(before.good(rules) > 0))
    # values only follow the noise where all frames are explained to within it without any
    if not any(
        all(evidence.is_well_explained(pose, rules) for pose in one.explained.poses)
        and not one.change.values
        and one.gain > rules.margin
        for one in tried
    ):
        best = max((one for one in tried if one.change.values), key=lambda t: t.gain, default=None)
        met = best.explained if best and best.gain > rules.margin else before
        tried += _with_values(case, met)
    found = simplest(tried, before, rules)
    if found.change or all(one.gain < rules.undecided for one in tried if one.change.values):
        return found
    more = further()
    before = Explained(before.poses + _as_it_is(session, more).poses)
    case = _Case(session, [*frames, *more][: len(before.poses)], before)
    return simplest([*_with_values(case, before)], before, rules)


def explanation(session: Session, frames: Frames) -> str | None:
    """The change that explains frames, in words; None where none of those tried does.

    The frames, by number, of a session of one body are not explained as they are; three in a row
    tell of a sensor that is one late.
    """
    return late_sensor(session, frames) or diagnosis(session, frames).change or None


def _as_it_is(session: Session, frames: Frames) -> Explained:
    """Poses of the session as it is, of fewer frames where a search takes long in vain."""
    rules, poses, left = DiagnosisRules(), list[ScoredPose | None](), DiagnosisRules().in_vain
    for number, views in frames:
        if poses and left < 0 and not evidence.is_well_explained(poses[-1], rules):
            break
        pose, made = best_pose(session, session.body, number, views)
        poses.append(pose)
        left -= made
    return Explained(tuple(poses))


def _without_values(case: _Case, others: Otherwise) -> Iterator[Tried]:
    """Changes that explain frames better: a race in which those far behind the best drop out."""
    session, before, runners = case.session, case.before, [_Runner(*each) for each in others]
    runners += [_Runner(change, case.frames) for change in changes(session)]
    rules, left = DiagnosisRules(), DiagnosisRules().all_guesses
    for k in range(len(case.frames)):
        best = 0.0
        racing = chain(list(runners), _less_simple(case, runners) if k == 0 else ())
        for place, runner in enumerate(racing):
            if left < 0 and (k == 0 or place > 0):
                break  # but for the best so far, which is soon done
            # what gains less drops out, and leads to no two changes
            least = min(rules.margin, rules.behind * best - runner.gain(before))
            left -= runner.advance(session, max(least, 0.0))
            best = max(best, runner.gain(before))
            if place >= len(runners):
                runners.append(runner)
        tried = [runner for runner in runners if len(runner.poses) > k]
        tried.sort(key=lambda runner: -runner.gain(before))
        # where none explains more of the first frame, one may of the second
        runners = [r for r in tried if r.gain(before) >= max(rules.behind * best, 0.0)]
    for runner in runners:
        gain = runner.gain(before)
        yield Tried(runner.change, Explained(tuple(runner.poses)), gain - runner.change.cost)


def _less_simple(case: _Case, runners: Sequence[_Runner]) -> Iterator[_Runner]:
    """Where the best of those so far do not explain the first frame: as cameras alone see it."""
    # and, where that does not either, those that explain most with every other change
    session, rules = case.session, DiagnosisRules()

    def best() -> list[_Runner]:
        ahead = [one for one in runners if one.gain(case.before) > rules.margin]
        ahead.sort(key=lambda one: -one.gain(case.before))
        if ahead and ahead[0].explains(rules):
            return []
        return [one for one in ahead if one.change.leads][: rules.leaders]

    first = [one for one in runners if one.poses and one.explains(rules)]
    if best() or not first:
        alone = by_cameras_alone(session, case.frames[:2])
        yield from [_Runner(change, case.frames) for change in alone]
    known = set[frozenset[str]]()  # two at once are the same whichever leads
    for one in best():
        for change in changes(session):
            both = frozenset([change.what + change.remedy, one.change.what + one.change.remedy])
            if change.leads and change.what != one.change.what and both not in known:
                known.add(both)
                yield _Runner(change.and_also(one.change), one.frames)


def _with_values(case: _Case, met: Explained) -> Iterator[Tried]:
    """Values that suit the matches of all frames, as they are `met`, better than those given."""
    session, frames, rules = case.session, case.frames, DiagnosisRules()
    known = [k for k, pose in enumerate(met.poses) if evidence_of(pose) > 0]
    posed = [(frames[k][1], pose) for k in known if (pose := met.poses[k]) is not None]
    if not posed:
        return
    given = Adjustment(
        session.body.means,
        {setup.name: setup.sensor for setup in session.sensors},
        evidence.seen_by(posed),
        [pose.T_world_object for _, pose in posed],
        evidence.beside(posed),
    )
    alone = replace(given, beside=[])  # what is beside a feature that is missed may be of another
    promises = [
        (promise(unknown, matches), unknown, matches)
        for unknown in unknowns(session)
        for matches in ((given, alone) if given.has(unknown) else (alone,))
    ]
    promising = [each for each in promises if each[0] > rules.promise]
    promising.sort(key=lambda each: -each[0] + each[1].cost)
    # one marker that is off has others beside it doubted, too
    markers = [each.feature for _, each, _ in promising if each.feature is not None]
    doubted = {None, *list(dict.fromkeys(markers))[: rules.markers]}
    promising = [each for each in promising if each[1].feature in doubted]
    for _, unknown, matches in promising[: rules.most]:
        yield from _fitted(case, known, matches, unknown)


def _fitted(
    case: _Case, known: Sequence[int], given: Adjustment, unknown: Unknown
) -> Iterator[Tried]:
    """A change by values, fitted twice: matches are better known by then."""
    session, frames, before = case.session, case.frames, case.before
    rules, found = DiagnosisRules(), list[Any]()
    for _ in range(2):
        fitted = adjusted(unknown, given)
        if fitted is None:
            return
        values, poses = fitted
        points = unknown.points(session.body.means, values)
        body = of_points(session.body, points, session.body.normals)
        seen = [_by(unknown, values, frames[k][1]) for k in known]
        numbers = [frames[k][0] for k in known]
        found = [evidence.pose_near(session, body, *each) for each in zip(numbers, seen, poses)]
        if any(pose is None for pose in found):
            return
        begun = [pose.T_world_object for pose in found]
        given = replace(given, frames=evidence.seen_by([*zip(seen, found)]), poses=begun, beside=[])
    after = list(before.poses)
    for k, pose in zip(known, found):
        after[k] = pose
    if Explained(tuple(after)).evidence <= before.evidence:
        return  # nor are the others worth a search then
    for k, (number, views) in enumerate(frames):
        # a pose that wrong values led to may be another one
        least = evidence_of(before.poses[k]) - rules.chance
        if k not in known or evidence_of(after[k]) < least:
            again, _ = best_pose(session, body, number, _by(unknown, values, views), rules.guesses)
            after[k] = max(again, after[k], key=evidence_of) if k in known else again
    explained, count = Explained(tuple(after)), len(values)
    unlikely = float(((values / unknown.deviations) ** 2).sum())
    cost = 0.5 * (count * math.log(max(2 * explained.met(), 2.0)) + unlikely)
    change = Change(
        unknown.what,
        unknown.remedy(values),
        lambda views: _by(unknown, values, views),
        lambda _: body,
        cost=cost,
        values=count,
        feature=unknown.feature,
    )
    yield Tried(change, explained, explained.evidence - before.evidence - cost - unknown.cost)


def _by(unknown: Unknown, values: Floats, views: Views) -> list[Any]:
    """Views by sensors of other values."""
    sensors = [unknown.sensor(view.name, view.sensor, values) for view in views]
    return [v if v.sensor is s else replace(v, sensor=s) for v, s in zip(views, sensors)]


def simplest(tried: Sequence[Tried], before: Explained, rules: DiagnosisRules) -> Diagnosis:
    """The simplest of the changes that explain most, and another that is as simple and good."""
    as_it_is = Diagnosis(good=before.good(rules), count=len(before.poses), rms=before.rms())
    told = [(one, _gain(one, before, rules)) for one in tried]
    told = [(one, gain) for one, gain in told if gain and one.gain > rules.margin]
    if not told:
        return as_it_is
    most = max(one.gain for one, _ in told)
    least = most - max(rules.rival, rules.share * abs(most))
    near = [each for each in told if each[0].gain > least]
    near.sort(key=lambda each: (each[0].change.values, -each[0].gain))
    (best, gain), *others = near
    change = best.change
    # two values of the same are no two answers
    rivals = [
        one
        for one, _ in others
        if one.change.values == change.values and one.change.what != change.what
    ]
    words = {"is": "may be", "are": "may be"} if rivals else {"is": "is", "are": "are"}
    told_of = [change, *(one.change for one in rivals[:1])]
    what = ", or ".join(each.what.format(**words) for each in told_of)
    remedies = ", or ".join(dict.fromkeys(each.remedy for each in told_of))
    return replace(as_it_is, change=f"{what}: {remedies}", gain=gain, likeliest=change)


def _gain(one: Tried, before: Explained, rules: DiagnosisRules) -> str:
    """What is better by a change, in words, of what it concerns; empty where that is little."""
    after, feature = one.explained, one.change.feature
    count, now, then = len(before.poses), after.good(rules), before.good(rules)
    met, rms = before.met(feature), before.rms(feature)
    if after.met() < rules.fewer * before.met():
        return ""  # what meets less is near some detections, as a body that is far too small
    if not now:
        return ""  # what explains no frame explains one sensor of several
    if now > then:
        as_is = f", {then} as it is" if then else ""
        return f"{now} of {count} frames are explained{as_is}"
    off = after.rms(feature)
    if off < rules.clearer * rms:
        what = "features are" if feature is None else "it is"
        return f"{what} met to {off:.2g} sigma in place of {rms:.2g} in {count} frames"
    more = round(after.met(feature) - met)
    if more < max(2.0, rules.more * met):
        return ""
    what = "features are met" if feature is None else "images show it"
    return f"{more} more {what} in {count} frames"


def late_sensor(session: Session, frames: Frames) -> str | None:
    """The sensor that is a frame late, in words; None of frames that are not in a row."""
    frames = frames[:IN_A_ROW]
    numbers = [number for number, _ in frames]
    if len(numbers) < IN_A_ROW or len({*np.diff(numbers).tolist()}) != 1:
        return None
    as_they_are = [_met(session, *one)[1] for one in frames]
    for setup in session.sensors:
        name = setup.name
        given = [  # the views of a frame, that of one sensor from the frame after
            [view for view in now if view.name != name] + [v for v in after if v.name == name]
            for (_, now), (_, after) in pairwise(frames)
        ]
        met = takewhile(itemgetter(0), (_met(session, *one) for one in zip(numbers, given)))
        offs = [off for _, off in met]
        if len(offs) == len(given) and max(offs) < _CLEARER * min(as_they_are):
            return f"{name!r} is a frame late: with each of its frames given to the one before"
    return None


def _met(session: Session, number: int, views: Views) -> tuple[bool, float]:
    """Whether a frame is ok by all of its sensors, and how far off they meet it, in sigma."""
    with np.errstate(all="ignore"):
        estimate = evidence.estimate_of(evidence.anywhere(session), number, views)
    # a sensor that is left out agrees with none of them
    shares = [(one.explained or 0.0) * one.used for one in estimate.sensors.values()]
    is_ok = estimate.status == "ok" and min(shares, default=0.0) > 0.1
    sigmas, rms = {view.name: view.observation.sigma for view in views}, estimate.weighted_rms
    offs = [math.inf if off is None else off / sigmas[name] for name, off in rms.items()]
    return is_ok, max(offs, default=math.inf)

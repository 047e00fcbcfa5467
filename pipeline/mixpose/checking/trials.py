"""Find the change of a session that explains its frames.

A few frames are estimated by the session as it is and by each of its changes; a change is reported
if it explains them with far more evidence.  Changes without values are tried if frames are not
explained; values are fitted to the matches of all frames, those that promise most first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
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

Extracted: TypeAlias = Sequence[tuple[Change, Frames]]
"""Changes of how features are extracted, each with the frames extracted that way."""

IN_A_ROW = 3
"""Number of consecutive frames that show whether a sensor is late."""

_CLEARER = 0.5  # of the offsets: those in frames of other moments are several times as large


@dataclass(frozen=True)
class Diagnosis:
    """The most likely error of a session by a few frames."""

    # what is wrong, and the remedy by which frames are explained; empty if no change is better
    change: str = ""
    gain: str = ""  # what the change explains, in words
    likeliest: Change | None = None  # if several may be the error
    # by the session as it is: frames that are explained, frames tried, and the median RMS offset
    explained: int = 0
    count: int = 0
    rms: float = 0.0  # in sigma


@dataclass
class _Runner:
    """A change in the race, with its poses of the frames tried so far."""

    change: Change
    frames: Frames
    poses: list[ScoredPose | None] = field(default_factory=list)

    def advance(self, session: Session, useful: float) -> int:
        """Search the next frame for a pose of `useful` evidence; return the number of guesses."""
        number, views = self.frames[len(self.poses)]
        body, changed = self.change.body(session.body), self.change.views(views)
        pose, made = best_pose(session, body, number, changed, DiagnosisRules().guesses, useful)
        self.poses.append(pose)
        return made

    def is_explaining(self, rules: DiagnosisRules) -> bool:
        """Test whether the change explains the last frame tried."""
        pose = self.poses[-1]
        return pose is not None and evidence.is_explained(pose, rules)

    def gain(self, before: Explained) -> float:
        """Return the nats gained over the session as it is in the frames tried."""
        return sum(evidence_of(a) - evidence_of(b) for a, b in zip(self.poses, before.poses))


@dataclass(frozen=True)
class _Case:
    """Frames of a session, and the poses that explain them without a change."""

    session: Session
    frames: Frames
    before: Explained


class Tried(NamedTuple):
    """A change that was tried, and the nats gained after its costs."""

    change: Change
    explained: Explained
    gain: float


def diagnosis(
    session: Session,
    frames: Frames,
    extracted: Callable[[bool], Extracted] = lambda _: (),
    further: Callable[[], Frames] = lambda: (),
) -> Diagnosis:
    """Find what is most likely wrong with a session of one body, by frames of its recording.

    Frames come with their numbers, those that show most first. `extracted`, given whether any frame
    is explained, returns changes of how features are extracted. `further` returns more frames, for
    a change by values that is undecided.
    """
    session, rules = evidence.without_start(session), DiagnosisRules()
    before = _unchanged(session, frames)
    case = _Case(session, frames[: len(before.poses)], before)
    frames = case.frames
    well = sum(evidence.is_well_explained(pose, rules) for pose in before.poses)
    tried = list[Tried]()
    if before.explained_count(rules) < len(frames) or 2 * well < len(frames):
        tried += _without_values(case, extracted(before.explained_count(rules) > 0))
    # if a change without values explains all frames to within the noise, values would only fit that
    if not any(
        all(evidence.is_well_explained(pose, rules) for pose in trial.explained.poses)
        and not trial.change.values
        and trial.gain > rules.margin
        for trial in tried
    ):
        best = max((t for t in tried if t.change.values), key=lambda t: t.gain, default=None)
        explained = best.explained if best and best.gain > rules.margin else before
        tried += _with_values(case, explained)
    likeliest = simplest(tried, before, rules)
    if likeliest.change or all(t.gain < rules.undecided for t in tried if t.change.values):
        return likeliest
    more = further()
    before = Explained(before.poses + _unchanged(session, more).poses)
    case = _Case(session, [*frames, *more][: len(before.poses)], before)
    return simplest([*_with_values(case, before)], before, rules)


def explanation(session: Session, frames: Frames) -> str | None:
    """Return the change that explains frames, in words; None if none of those tried does.

    The session has one body and does not explain the frames as it is; three frames in a row also
    show a sensor that is one frame late.
    """
    return late_sensor(session, frames) or diagnosis(session, frames).change or None


def _unchanged(session: Session, frames: Frames) -> Explained:
    """Search poses by the session as it is, in fewer frames if a long search is in vain."""
    rules, poses, remaining = DiagnosisRules(), list[ScoredPose | None](), DiagnosisRules().in_vain
    for number, views in frames:
        if poses and remaining < 0 and not evidence.is_well_explained(poses[-1], rules):
            break
        pose, made = best_pose(session, session.body, number, views)
        poses.append(pose)
        remaining -= made
    return Explained(tuple(poses))


def _without_values(case: _Case, others: Extracted) -> Iterator[Tried]:
    """Try changes in a race through the frames in which those far behind the best drop out."""
    session, before, runners = case.session, case.before, [_Runner(*each) for each in others]
    runners += [_Runner(change, case.frames) for change in changes(session)]
    rules, remaining = DiagnosisRules(), DiagnosisRules().all_guesses
    for k in range(len(case.frames)):
        best = 0.0
        racing = chain(list(runners), _more_complex(case, runners) if k == 0 else ())
        for place, runner in enumerate(racing):
            if remaining < 0 and (k == 0 or place > 0):
                break  # only the best so far goes on, which takes few guesses
            # a change that gains less drops out, and is not combined with others
            least = min(rules.margin, rules.behind * best - runner.gain(before))
            remaining -= runner.advance(session, max(least, 0.0))
            best = max(best, runner.gain(before))
            if place >= len(runners):
                runners.append(runner)
        tried = [runner for runner in runners if len(runner.poses) > k]
        tried.sort(key=lambda runner: -runner.gain(before))
        # if none gains in the first frame, one may in the second
        runners = [r for r in tried if r.gain(before) >= max(rules.behind * best, 0.0)]
    for runner in runners:
        gain = runner.gain(before)
        yield Tried(runner.change, Explained(tuple(runner.poses)), gain - runner.change.cost)


def _more_complex(case: _Case, runners: Sequence[_Runner]) -> Iterator[_Runner]:
    """Yield changes by single cameras, then pairs, while the best so far do not explain a frame."""
    session, rules = case.session, DiagnosisRules()

    def leaders() -> list[_Runner]:
        ahead = [runner for runner in runners if runner.gain(case.before) > rules.margin]
        ahead.sort(key=lambda runner: -runner.gain(case.before))
        if ahead and ahead[0].is_explaining(rules):
            return []
        return [runner for runner in ahead if runner.change.leads][: rules.leaders]

    explaining = [runner for runner in runners if runner.poses and runner.is_explaining(rules)]
    if leaders() or not explaining:
        alone = by_cameras_alone(session, case.frames[:2])
        yield from [_Runner(change, case.frames) for change in alone]
    known = set[frozenset[str]]()  # a pair of changes is the same whichever leads
    for leader, frames in [(runner.change, runner.frames) for runner in leaders()]:
        for change in changes(session):
            both = frozenset([change.what + change.remedy, leader.what + leader.remedy])
            if change.leads and change.what != leader.what and both not in known:
                known.add(both)
                yield _Runner(change.and_also(leader), frames)


def _with_values(case: _Case, explained: Explained) -> Iterator[Tried]:
    """Fit values of the session to the matches of the poses that explain its frames."""
    session, frames, rules = case.session, case.frames, DiagnosisRules()
    known = [k for k, pose in enumerate(explained.poses) if evidence_of(pose) > 0]
    posed = [(frames[k][1], pose) for k in known if (pose := explained.poses[k]) is not None]
    if not posed:
        return
    given = Adjustment(
        session.body.means,
        {setup.name: setup.sensor for setup in session.sensors},
        evidence.matches_of(posed),
        [pose.T_world_object for _, pose in posed],
        evidence.nearest_to_missed(posed),
    )
    met = replace(given, nearest=[])  # the detection nearest to a missed feature may be of another
    promises = [
        (promise(unknown, matches), unknown, matches)
        for unknown in unknowns(session)
        for matches in ((given, met) if given.has_nearest(unknown) else (met,))
    ]
    promising = [entry for entry in promises if entry[0] > rules.promise]
    promising.sort(key=lambda entry: -entry[0] + entry[1].cost)
    # a marker that is off lets others seem to be off, too
    markers = [unknown.feature for _, unknown, _ in promising if unknown.feature is not None]
    doubted = {None, *list(dict.fromkeys(markers))[: rules.markers]}
    promising = [entry for entry in promising if entry[1].feature in doubted]
    for _, unknown, matches in promising[: rules.most]:
        yield from _fitted(case, known, matches, unknown)


def _fitted(
    case: _Case, known: Sequence[int], given: Adjustment, unknown: Unknown
) -> Iterator[Tried]:
    """Fit values twice, the second time to the matches of the first fit, and try that change."""
    session, frames, before = case.session, case.frames, case.before
    rules, fits = DiagnosisRules(), list[Any]()
    for _ in range(2):
        fitted = adjusted(unknown, given)
        if fitted is None:
            return
        values, poses = fitted
        points = unknown.points(session.body.means, values)
        body = of_points(session.body, points, session.body.normals)
        views = [_with(unknown, values, frames[k][1]) for k in known]
        numbers = [frames[k][0] for k in known]
        fits = [evidence.pose_near(session, body, *args) for args in zip(numbers, views, poses)]
        if any(pose is None for pose in fits):
            return
        starts, posed = [pose.T_world_object for pose in fits], [*zip(views, fits)]
        given = replace(given, frames=evidence.matches_of(posed), poses=starts, nearest=[])
    after = list(before.poses)
    for k, pose in zip(known, fits):
        after[k] = pose
    if Explained(tuple(after)).evidence <= before.evidence:
        return  # searching the other frames is not worth it then
    for k, (number, seen) in enumerate(frames):
        # wrong values may have led to a wrong pose: search for another
        least = evidence_of(before.poses[k]) - rules.chance
        if k not in known or evidence_of(after[k]) < least:
            fit, _ = best_pose(session, body, number, _with(unknown, values, seen), rules.guesses)
            after[k] = max(fit, after[k], key=evidence_of) if k in known else fit
    explained, count = Explained(tuple(after)), len(values)
    unlikely = float(((values / unknown.deviations) ** 2).sum())
    cost = 0.5 * (count * math.log(max(2 * explained.met_count(), 2.0)) + unlikely)
    changed, remedy = partial(_with, unknown, values), unknown.remedy(values)
    change = Change(unknown.what, remedy, changed, lambda _: body, cost, count, unknown.feature)
    yield Tried(change, explained, explained.evidence - before.evidence - cost - unknown.cost)


def _with(unknown: Unknown, values: Floats, views: Views) -> list[Any]:
    """Return the views with sensors changed by values."""
    sensors = [unknown.sensor(view.name, view.sensor, values) for view in views]
    return [v if v.sensor is s else replace(v, sensor=s) for v, s in zip(views, sensors)]


def simplest(tried: Sequence[Tried], before: Explained, rules: DiagnosisRules) -> Diagnosis:
    """Report the simplest of the changes that explain most, with a rival as simple if any."""
    count, explained = len(before.poses), before.explained_count(rules)
    as_it_is = Diagnosis(explained=explained, count=count, rms=before.rms())
    gains = [(trial, _gain(trial, before, rules)) for trial in tried]
    gains = [(trial, gain) for trial, gain in gains if gain and trial.gain > rules.margin]
    if not gains:
        return as_it_is
    most = max(trial.gain for trial, _ in gains)
    least = most - max(rules.rival, rules.share * abs(most))
    near = [(trial, gain) for trial, gain in gains if trial.gain > least]
    near.sort(key=lambda pair: (pair[0].change.values, -pair[0].gain))
    (best, gain), *others = near
    change = best.change
    # other values of the same thing are no rival
    rivals = [trial.change for trial, _ in others if trial.change.what != change.what]
    rivals = [rival for rival in rivals if rival.values == change.values]
    words = {"is": "may be", "are": "may be"} if rivals else {"is": "is", "are": "are"}
    reported = [change, *rivals[:1]]
    what = ", or ".join(c.what.format(**words) for c in reported)
    remedies = ", or ".join(dict.fromkeys(c.remedy for c in reported))
    return replace(as_it_is, change=f"{what}: {remedies}", gain=gain, likeliest=change)


def _gain(trial: Tried, before: Explained, rules: DiagnosisRules) -> str:
    """Say in words what a change explains better; empty if that is too little to report."""
    after, feature, count = trial.explained, trial.change.feature, len(before.poses)
    now, then = after.explained_count(rules), before.explained_count(rules)
    met, rms = before.met_count(feature), before.rms(feature)
    if after.met_count() < rules.fewer * before.met_count():
        return ""  # a wrong change, as a body far too small, is near fewer detections
    if not now:
        return ""  # a change that explains no frame suits one sensor of several only
    if now > then:
        as_is = f", {then} as it is" if then else ""
        return f"{now} of {count} frames are explained{as_is}"
    off = after.rms(feature)
    if off < rules.clearer * rms:
        what = "features are" if feature is None else "it is"
        return f"{what} met to {off:.2g} sigma in place of {rms:.2g} in {count} frames"
    more = round(after.met_count(feature) - met)
    if more < max(2.0, rules.more * met):
        return ""
    what = "features are met" if feature is None else "images show it"
    return f"{more} more {what} in {count} frames"


def late_sensor(session: Session, frames: Frames) -> str | None:
    """Return in words which sensor is a frame late; None if none is or frames are not in a row."""
    frames = frames[:IN_A_ROW]
    numbers = [number for number, _ in frames]
    if len(numbers) < IN_A_ROW or len({*np.diff(numbers).tolist()}) != 1:
        return None
    offsets = [_offset(session, *frame)[1] for frame in frames]
    for setup in session.sensors:
        name = setup.name
        shifted = [  # views of a frame, with that of one sensor from the frame after
            [view for view in now if view.name != name] + [v for v in after if v.name == name]
            for (_, now), (_, after) in pairwise(frames)
        ]
        fits = takewhile(itemgetter(0), (_offset(session, *f) for f in zip(numbers, shifted)))
        closer = [offset for _, offset in fits]
        if len(closer) == len(shifted) and max(closer) < _CLEARER * min(offsets):
            return f"{name!r} is a frame late: with each of its frames given to the one before"
    return None


def _offset(session: Session, number: int, views: Views) -> tuple[bool, float]:
    """Return whether a frame is ok by all of its sensors, and the largest RMS offset, in sigma."""
    with np.errstate(all="ignore"):
        estimate = evidence.estimate_of(evidence.without_start(session), number, views)
    # a sensor that was left out does not agree
    shares = [(sensor.explained or 0.0) * sensor.used for sensor in estimate.sensors.values()]
    is_ok = estimate.status == "ok" and min(shares, default=0.0) > 0.1
    sigmas, rms = {view.name: view.observation.sigma for view in views}, estimate.weighted_rms
    offsets = [math.inf if off is None else off / sigmas[name] for name, off in rms.items()]
    return is_ok, max(offsets, default=math.inf)

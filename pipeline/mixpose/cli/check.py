"""``mixpose check``: what a session says and its recording holds, before poses are estimated."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mixpose.body import default_tolerance, is_on_a_line
from mixpose.checking import geometry, keys, lookalikes, placement, recordings
from mixpose.cli.app import CheckRequest
from mixpose.cli.notices import bar
from mixpose.cli.run import named_sources
from mixpose.errors import RecordingError
from mixpose.fit import free_mask
from mixpose.frames import ALL_NUMBERS, Source, numbers_of
from mixpose.frames.tables import DetectionTable
from mixpose.judgement import expected_covariance
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES, transform
from mixpose.runner import open_sources
from mixpose.session import ObjectSetup, SensorSetup, Session, load_session

_TYPICAL_POSES = 3
_AWAY = (1.0, 2.0, 4.0)  # times the distance at which the body fills half of one camera's image
_ALL_WAYS = np.pi / 2  # a turn that is less certain than this, in radians, is not known at all


@dataclass
class _Report:
    """Lines for people, warnings last, so that they are on the screen in the end."""

    lines: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    of_counts: list[str] = field(default_factory=list)  # of features
    of: str = ""  # of several bodies, which one is spoken of

    def say(self, title: str, text: str) -> None:
        self.lines.append(f"{title:<10}{self.of}{text}")

    def warn(self, text: str) -> None:
        self.warnings.append(f"{self.of}{text}")

    def write(self, tried: str, beside: str = "") -> None:
        """Print all; `tried` is what is known where nothing is warned of, `beside` what follows."""
        for warning in self.warnings:
            self.say("warning", warning)
        if not self.warnings:
            self.say("warnings", f"none{beside}; {tried}")
        sys.stdout.write("\n".join(self.lines) + "\n")


def check_session(request: CheckRequest) -> None:
    """Print sensors, recordings, the object's symmetries and the expected accuracy.

    Raises SessionError as ``mixpose run`` would before its first frame, and RecordingError if a
    recording cannot be opened or its table of times lacks rows, or, after all has been printed, if
    a frame is damaged.
    """
    session, quick = load_session(request.session, allow_code=request.allow_code), request.quick
    replaced = named_sources(request.source or ())
    opened = open_sources(session, replaced)
    for source in opened.values():
        source.check_times(ALL_NUMBERS)
    report = _Report()
    report.say("session", f"{session.path}, lengths in {session.unit}")
    for one in session.objects:
        _say_object(report, session, one)
    surveys: dict[str, recordings.Survey] = {}
    some = None if quick else recordings.frames_to_count(opened)
    lengths = [source.length for source in opened.values()]
    total = None if None in lengths else sum(length or 0 for length in lengths)
    with bar("reading frames", total, shown=not quick) as moved:
        for setup in session.sensors:
            source = opened[setup.name]
            surveys[setup.name] = recordings.survey(
                session, setup, source, quick=quick, to_count=some, done=partial(moved, advance=1)
            )
    for setup in session.sensors:
        _say_sensor(report, session, setup, opened[setup.name], surveys)
    shared = keys.shared_source_warnings(session, replaced)
    sizes = {name: each.size for name, each in surveys.items()}
    doubts = geometry.geometry_doubts(session, opened, surveys)
    given = _of_geometry(placement.with_image_sizes(doubts.mended or session, sizes))
    report.lines += given.lines
    if doubts.mended is None:
        counts = keys.with_own_tables(report.of_counts, len(session.sensors))
        report.warnings = [*counts, *report.warnings, *given.warnings, *doubts.warnings]
        if doubts.unexplained and not (report.of_counts or doubts.warnings):
            report.warnings.append(doubts.unexplained)
    else:  # the cause first, then what is odd all the same
        report.warnings = [*doubts.warnings, *report.warnings, *given.warnings]
    # files and numbers are sure, and what is given twice or out of step may look moved
    report.warnings = [
        *shared,
        *_pairing_warnings(opened),
        *recordings.numbering_warnings(opened),
        *recordings.order_warnings(surveys),
        *recordings.time_warnings(surveys),
        *recordings.frozen_warnings(surveys),
        *report.warnings,
    ]
    first = min((min(each.numbers) for each in surveys.values() if each.numbers), default=0)
    not_tried = f"no frame was estimated, which mixpose run --stop {first + 3} does"
    damage = [text for each in surveys.values() for text in each.damage]
    beside = " but for the error that follows" if damage else ""
    report.write(doubts.tried or not_tried, beside)
    if damage:
        more = f" (and {len(damage) - 1} more, see above)" if len(damage) > 1 else ""
        raise RecordingError(f"{damage[0]}{more}")


def _of_geometry(session: Session) -> _Report:
    """What is said of where sensors stand and what they see of the bodies there."""
    report = _Report()
    report.warnings += keys.key_warnings(session) + placement.placement_warnings(session)
    for one in session.objects:
        report.of = f"{one.body.name}: " if len(session.objects) > 1 else ""
        _say_accuracy(report, session.alone(one.body.name))
    report.of = ""
    report.warnings += keys.shared_part_warnings(session)
    return report


def _say_object(report: _Report, session: Session, one: ObjectSetup) -> None:
    body = one.body
    spread = f", spread up to {body.spread:g} {session.unit}" if body.spread else ", exact"
    extent = f"{len(body)} features within {body.radius:.4g} {session.unit} of their centre"
    many = f", {one.count} that are identical" if one.count > 1 else ""
    report.say("object", f"{body.name}: {extent}{spread}{many}")
    alike, of = len(body.symmetries), f"{body.name}: " if len(session.objects) > 1 else ""
    within = f" within {body.asymmetry:.2g} {session.unit}" if body.asymmetry else ""
    same = f"{alike} orientations look the same{within}" if alike > 1 else "none"
    points = body.nodes.points
    if free_mask(session.estimator)[3:].all() and is_on_a_line(points, default_tolerance(points)):
        same = "all turns about the line of its features look the same: no frame has its pose"
    written = "; the pose nearest to the previous one is written" if alike > 1 else ""
    report.say("symmetry", f"{of}{same}{written}")


def _say_sensor(
    report: _Report,
    session: Session,
    setup: SensorSetup,
    source: Source,
    surveys: Mapping[str, recordings.Survey],
) -> None:
    found = surveys[setup.name]
    size = "" if setup.resolution is None else f" {setup.resolution[0]}x{setup.resolution[1]}"
    report.say("sensor", f"{setup.name}: {setup.model}{size}, {_extraction(setup, session.unit)}")
    for line in placement.placement_lines(setup, session.unit):
        report.say("", line)
    total = len(found.numbers) + len(found.damage)
    read = "all read" if found.is_whole else f"looked at {total}"
    if found.damage:
        read = f"{len(found.damage)} of the {total} looked at cannot be read"
    report.say("", f"{source.describe()}; {read}" if not found.damage or found.numbers else read)
    for text in found.damage[: recordings.LISTED]:
        report.say("", f"damaged: {text}")
    where = f"sensor {setup.name!r}"
    caution = source.caution()
    if caution:
        report.warnings.append(f"{where}: {caution}")
    if all(each.is_whole for each in surveys.values()):
        _say_missing(report, setup.name, surveys)
    _say_features(report, session, setup, source, found)


def _say_missing(report: _Report, name: str, surveys: Mapping[str, recordings.Survey]) -> None:
    """Frames that other sensors have."""
    own = {*surveys[name].numbers, *surveys[name].damaged}
    others = [each for other, each in surveys.items() if other != name]
    known = set().union(*(each.numbers for each in others))
    missing = sorted(known - own)
    if missing:
        everyone = len(known | own)
        report.say(
            "", f"missing: {recordings.listed(missing)} of the {everyone} frames of all sensors"
        )


def _pairing_warnings(sources: Mapping[str, Source]) -> list[str]:
    """Sensors whose frames hardly pair with those of others, told by numbers alone."""
    numbers = {name: found for name, each in sources.items() if (found := numbers_of(each))}
    warnings = []
    for name, own in numbers.items():
        known = set().union(*(each for other, each in numbers.items() if other != name))
        pairs = len(own & known)
        if known and pairs < 0.5 * min(len(own), len(known)):
            is_table = isinstance(sources[name], DetectionTable)
            by = (
                "in the column frame; count all tables alike"
                if is_table
                else "that their names end in; rename the files"
            )
            warnings.append(
                f"sensor {name!r}: {pairs} of its {len(own)} frames pair with those of other "
                f"sensors: frames are paired by the number {by}"
            )
    for (one, own), (other, others) in combinations(numbers.items(), 2):
        if own & others and own != others and {k - min(own) + min(others) for k in own} == others:
            warnings.append(
                f"sensors {one!r} and {other!r} have {len(own)} frames each, numbered from "
                f"{min(own)} and from {min(others)}: if both began at once, number those of one "
                "anew, as frames of one number are taken together"
            )
    return warnings


def _say_features(
    report: _Report, session: Session, setup: SensorSetup, source: Source, found: recordings.Survey
) -> None:
    where = f"sensor {setup.name!r}"
    alone = [(session.alone(one.body.name), one.count) for one in session.objects]
    expected = sum(count * placement.expected_count(setup, each) for each, count in alone)
    if not (found.numbers or found.damage):
        report.warnings.append(f"{where}: its recording has no frame")
    if found.counts is None:
        if found.numbers and found.empty:
            frames = recordings.listed(found.empty)
            report.warnings.append(f"{where}: nothing but one value in frame {frames}")
        return
    low, high = min(found.counts), max(found.counts)
    middle = float(np.median(found.counts))
    of = "" if len(found.counted) == len(found.numbers) else f" of {len(found.counted)} frames"
    counts = f"{low} / {middle:g} / {high} (least / median / most{of})"
    report.say("", f"features per frame: {counts}, expected: {expected}")
    fewest = min(placement.fewest_count(setup, each) for each, _ in alone)
    judgement = keys.judge(middle, expected, fewest if len(session.labels) == 1 else None)
    if judgement is not None:
        number = found.typical_frame
        assert number is not None, "there are counts"
        image = recordings.image_of(source, number)
        count = found.counts[found.counted.index(number)]
        report.of_counts.append(
            f"{where}: {judgement} features, {count} in frame {number} where "
            f"{expected} are expected: {keys.advice(session, setup, number, image, expected)}"
        )
    elif found.empty:
        report.warnings.append(f"{where}: no feature in frame {recordings.listed(found.empty)}")


def _extraction(setup: SensorSetup, length_unit: str) -> str:
    unit = "px" if setup.sensor.unit == "px" else length_unit
    if setup.model in ("lateration", "cloud"):
        return f"sigma {setup.extract.sigma:g} {unit}"
    # corners are where dark and bright meet
    polarity = "" if setup.extract.method == "corners" else f" ({setup.extract.polarity})"
    return f"{setup.extract.method}{polarity}, sigma {setup.extract.sigma:g} {unit}"


def _say_accuracy(report: _Report, session: Session) -> None:
    """What is in view, how accurate poses will be, and which poses look alike."""
    if session.start is not None:
        _say_accuracy_at(report, session, [session.start.T_world_object], "at [start]")
        return
    several = placement.depends_on_distance(session)
    for away in _AWAY if several else _AWAY[:1]:
        poses = placement.typical_poses(session, _TYPICAL_POSES, away=away)
        if not poses:
            report.say("start", "none, and no place is in view of the sensors: add [start]")
            return
        where = "in the middle of the sensors' common view"
        if several:
            middle = transform(np.array(poses), session.body.means.mean(axis=0)[None])[:, 0]
            away_by = np.linalg.norm(session.sensors[0].sensor.towards(middle), axis=1).mean()
            where = f"{float(f'{away_by:.3g}'):g} {session.unit} away"
        if away == _AWAY[0]:
            report.say(
                "start",
                f"none: the first pose is searched for; below, the body is assumed {where}, in "
                f"{len(poses)} orientations",
            )
        if _say_accuracy_at(report, session, poses, where, brief=away != _AWAY[0]):
            return


def _say_accuracy_at(
    report: _Report, session: Session, poses: list[Floats], where: str, *, brief: bool = False
) -> bool:
    """Say it for some poses; returns whether other poses look like one of them."""
    free = free_mask(session.estimator)
    sensors = [setup.sensor for setup in session.sensors]
    sigmas = [setup.extract.sigma for setup in session.sensors]
    expected = [expected_covariance(sensors, sigmas, session.body, T, free) for T in poses]
    if not brief:
        counts = np.median([counts for _, counts in expected], axis=0)
        seen = ", ".join(
            f"{setup.name} {count:g}/{len(session.body)}"
            for setup, count in zip(session.sensors, counts, strict=True)
        )
        report.say("in view", f"{where}: {seen}")
        deviations = np.median([np.sqrt(np.diag(c)) for c, _ in expected], axis=0)
        deviations[3:][deviations[3:] > _ALL_WAYS] = np.inf
        report.say(
            "accuracy",
            f"one standard deviation {where}, if each feature errs by sigma: "
            f"{_deviations(deviations, session.unit, free)}",
        )
        unknown = [TWIST_NAMES[k] for k in np.flatnonzero(free & ~np.isfinite(deviations))]
        if unknown:
            report.warn(
                f"{where}, the sensors do not determine {', '.join(unknown)}: hold what is known "
                "at the pose of [start] with free in [estimator], or add a sensor"
            )
    others = [
        lookalikes.look_alikes(session.sensors, session.body, T, free)
        for T, (covariance, _) in zip(poses, expected, strict=True)
        if np.isfinite(np.diag(covariance)).all()
    ]
    found = [alike for alike in others if alike]
    if found:
        report.warn(_look_alike_text(session, found, len(poses), where))
    return bool(found)


def _look_alike_text(
    session: Session, found: list[list[lookalikes.LookAlike]], tried: int, where: str
) -> str:
    best = min((alike[0] for alike in found), key=lambda other: other.difference)
    orientations = f" in {len(found)} of {tried} orientations" if tried > 1 else ""
    count = max(map(len, found))
    poses = "another pose looks" if count == 1 else f"{count} other poses look"
    largest = max(session.sensors, key=lookalikes.noise_of)
    unit = "px" if largest.sensor.unit == "px" else session.unit
    return (
        f"{where}{orientations}, {poses} the same where features err by "
        f"{lookalikes.noise_of(largest):.2g} {unit} (turned by {best.turn_deg:.0f} deg, "
        f"{best.difference:.1f} standard deviations apart): expect ambiguous frames, or move a "
        "marker out of line and plane, come closer, or add a sensor"
    )


def _deviations(deviations: Floats, unit: str, free: NDArray[np.bool_]) -> str:
    scale = np.array([1.0] * 3 + [180 / np.pi] * 3)
    units = [unit] * 3 + ["deg"] * 3
    return ", ".join(
        f"{name} {value:.3g} {each}" if np.isfinite(value) else f"{name} not determined"
        for name, value, each, is_free in zip(
            TWIST_NAMES, deviations * scale, units, free, strict=True
        )
        if is_free
    )

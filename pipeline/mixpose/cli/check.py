"""``mixpose check``: report on a session and its recording before poses are estimated."""

from __future__ import annotations

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
from mixpose.cli.output import print_lines
from mixpose.cli.run import named_sources
from mixpose.errors import RecordingError
from mixpose.fit import free_mask
from mixpose.frames import ALL_NUMBERS, Source, numbers_of
from mixpose.frames.tables import DetectionTable
from mixpose.frames.times import LISTED, listed
from mixpose.judgement import expected_covariance
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES, transform
from mixpose.runner import open_sources
from mixpose.session import ObjectSetup, SensorSetup, Session, load_session

_TYPICAL_POSES = 3
_AWAY = (1.0, 2.0, 4.0)  # times the distance at which the body fills half of one camera's image
_ALL_WAYS = np.pi / 2  # standard deviation of a turn, in radians, above which it is not known


@dataclass
class _Report:
    """Lines to be printed about a session, warnings last, so that they stay on the screen."""

    session: Session
    lines: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    count_warnings: list[str] = field(default_factory=list)  # warnings about numbers of features
    prefix: str = ""  # the name of one of several bodies

    def say(self, title: str, text: str) -> None:
        self.lines.append(f"{title:<10}{self.prefix}{text}")

    def warn(self, text: str) -> None:
        self.warnings.append(f"{self.prefix}{text}")

    def write(self, tried: str, qualifier: str = "") -> None:
        """Print all lines; without warnings, `tried` says what was tested, after a `qualifier`."""
        for warning in self.warnings:
            self.say("warning", warning)
        if not self.warnings:
            self.say("warnings", f"none{qualifier}; {tried}")
        print_lines(self.lines)


def check_session(request: CheckRequest) -> None:
    """Print what a session and its recording hold and let expect; raise if a frame is damaged."""
    session, quick = load_session(request.session, allow_code=request.allow_code), request.quick
    replaced = named_sources(request.source or ())
    opened = open_sources(session, replaced)
    for source in opened.values():
        source.check_times(ALL_NUMBERS)
    report = _Report(session)
    report.say("session", f"{session.path}, lengths in {session.unit}")
    for table in session.objects:
        _say_object(report, table)
    sample = None if quick else recordings.frames_to_count(opened)
    lengths = [source.length for source in opened.values()]
    total = None if None in lengths else sum(length or 0 for length in lengths)
    with bar("reading frames", total, shown=not quick) as tick:
        tell = partial(tick, advance=1)
        read = partial(recordings.survey, quick=quick, to_count=sample, done=tell)
        surveys = {s.name: read(session, s, opened[s.name]) for s in session.sensors}
    for setup in session.sensors:
        _say_sensor(report, setup, opened[setup.name], surveys)
    shared = keys.shared_source_warnings(session, replaced)
    sizes = {name: survey.size for name, survey in surveys.items()}
    doubts = geometry.geometry_doubts(session, opened, surveys)
    placed = _of_geometry(placement.with_image_sizes(doubts.mended or session, sizes))
    report.lines += placed.lines
    if doubts.mended is None:
        counts = keys.with_own_tables(report.count_warnings, len(session.sensors))
        report.warnings = [*counts, *report.warnings, *placed.warnings, *doubts.warnings]
        if doubts.unexplained and not (report.count_warnings or doubts.warnings):
            report.warnings.append(doubts.unexplained)
    else:  # the cause first, then what remains odd
        report.warnings = [*doubts.warnings, *report.warnings, *placed.warnings]
    # faults of files and numbers are certain, and may make sensors look displaced
    report.warnings = [
        *shared,
        *_pairing_warnings(opened),
        *recordings.numbering_warnings(opened),
        *recordings.order_warnings(surveys),
        *recordings.time_warnings(surveys),
        *recordings.frozen_warnings(surveys),
        *report.warnings,
    ]
    first = min((min(survey.numbers) for survey in surveys.values() if survey.numbers), default=0)
    not_tried = f"no frame was estimated, which mixpose run --stop {first + 3} does"
    damage = [text for survey in surveys.values() for text in survey.damage]
    qualifier = " but for the error that follows" if damage else ""
    report.write(doubts.tried or not_tried, qualifier)
    if damage:
        suffix = f" (and {len(damage) - 1} more, see above)" if len(damage) > 1 else ""
        raise RecordingError(f"{damage[0]}{suffix}")


def _of_geometry(session: Session) -> _Report:
    """Report on the placement of sensors, their views of the bodies and the expected accuracy."""
    report = _Report(session)
    report.warnings += keys.key_warnings(session) + placement.placement_warnings(session)
    for setup in session.objects:
        report.prefix = f"{setup.body.name}: " if len(session.objects) > 1 else ""
        _say_accuracy(report, session.with_only(setup.body.name))
    report.warnings += keys.shared_part_warnings(session)
    return report


def _say_object(report: _Report, setup: ObjectSetup) -> None:
    session, body, unit = report.session, setup.body, report.session.unit
    spread = f", spread up to {body.spread:g} {unit}" if body.spread else ", exact"
    extent = f"{len(body)} features within {body.radius:.4g} {unit} of their centre"
    identical = f", {setup.count} that are identical" if setup.count > 1 else ""
    report.say("object", f"{body.name}: {extent}{spread}{identical}")
    count, prefix = len(body.symmetries), f"{body.name}: " if len(session.objects) > 1 else ""
    within = f" within {body.asymmetry:.2g} {unit}" if body.asymmetry else ""
    symmetry = f"{count} orientations look the same{within}" if count > 1 else "none"
    points = body.nodes.points
    if free_mask(session.estimator)[3:].all() and is_on_a_line(points, default_tolerance(points)):
        symmetry = "all turns about the line of its features look the same: no frame has its pose"
    written = "; the pose nearest to the previous one is written" if count > 1 else ""
    report.say("symmetry", f"{prefix}{symmetry}{written}")


def _say_sensor(
    report: _Report, setup: SensorSetup, source: Source, surveys: Mapping[str, recordings.Survey]
) -> None:
    survey, unit = surveys[setup.name], report.session.unit
    size = "" if setup.resolution is None else f" {setup.resolution[0]}x{setup.resolution[1]}"
    report.say("sensor", f"{setup.name}: {setup.model}{size}, {_extraction(setup, unit)}")
    for line in placement.placement_lines(setup, unit):
        report.say("", line)
    total = len(survey.numbers) + len(survey.damage)
    read = "all read" if survey.is_whole else f"looked at {total}"
    if survey.damage:
        read = f"{len(survey.damage)} of the {total} looked at cannot be read"
    report.say("", read if survey.damage and not survey.numbers else f"{source.describe()}; {read}")
    for text in survey.damage[:LISTED]:
        report.say("", f"damaged: {text}")
    if caution := source.caution():
        report.warn(f"sensor {setup.name!r}: {caution}")
    numbers = {*survey.numbers, *survey.damaged}
    all_numbers = numbers.union(*(other.numbers for other in surveys.values()))
    missing = listed(sorted(all_numbers - numbers))
    if missing and all(other.is_whole for other in surveys.values()):
        report.say("", f"missing: {missing} of the {len(all_numbers)} frames of all sensors")
    _say_features(report, setup, source, survey)


def _pairing_warnings(sources: Mapping[str, Source]) -> list[str]:
    """Return warnings of sensors whose frame numbers hardly pair with those of others."""
    numbers = {name: frames for name, source in sources.items() if (frames := numbers_of(source))}
    warnings = []
    for name, frames in numbers.items():
        other_numbers = set().union(*(numbers[other] for other in numbers if other != name))
        pairs = len(frames & other_numbers)
        if other_numbers and pairs < 0.5 * min(len(frames), len(other_numbers)):
            hint = "that their names end in; rename the files"
            if isinstance(sources[name], DetectionTable):
                hint = "in the column frame; count all tables alike"
            warnings.append(
                f"sensor {name!r}: {pairs} of its {len(frames)} frames pair with those of other "
                f"sensors: frames are paired by the number {hint}"
            )
    for (name, frames), (other, others) in combinations(numbers.items(), 2):
        shift = min(others) - min(frames)
        if frames & others and frames != others and {k + shift for k in frames} == others:
            warnings.append(
                f"sensors {name!r} and {other!r} have {len(frames)} frames each, numbered from "
                f"{min(frames)} and from {min(others)}: if both began at once, number those of one "
                "anew, as frames of one number are taken together"
            )
    return warnings


def _say_features(
    report: _Report, setup: SensorSetup, source: Source, survey: recordings.Survey
) -> None:
    session, sensor = report.session, f"sensor {setup.name!r}"
    singles = [(session.with_only(table.body.name), table.count) for table in session.objects]
    expected = sum(count * placement.expected_count(setup, single) for single, count in singles)
    if not (survey.numbers or survey.damage):
        report.warn(f"{sensor}: its recording has no frame")
    if survey.counts is None:
        if survey.numbers and survey.empty:
            frames = listed(survey.empty)
            report.warn(f"{sensor}: nothing but one value in frame {frames}")
        return
    low, high = min(survey.counts), max(survey.counts)
    middle = float(np.median(survey.counts))
    counted = len(survey.counted)
    basis = "" if counted == len(survey.numbers) else f" of {counted} frames"
    counts = f"{low} / {middle:g} / {high} (least / median / most{basis})"
    report.say("", f"features per frame: {counts}, expected: {expected}")
    fewest = min(placement.fewest_count(setup, single) for single, _ in singles)
    judgement = keys.judge(middle, expected, fewest if len(session.labels) == 1 else None)
    if judgement is not None:
        typical = survey.typical_frame
        assert typical is not None, "there are counts"
        image = recordings.image_of(source, typical)
        count = survey.counts[survey.counted.index(typical)]
        report.count_warnings.append(
            f"{sensor}: {judgement} features, {count} in frame {typical} where "
            f"{expected} are expected: {keys.advice(session, setup, typical, image, expected)}"
        )
    elif survey.empty:
        report.warn(f"{sensor}: no feature in frame {listed(survey.empty)}")


def _extraction(setup: SensorSetup, length_unit: str) -> str:
    unit = "px" if setup.sensor.unit == "px" else length_unit
    if setup.model in ("lateration", "cloud"):
        return f"sigma {setup.extract.sigma:g} {unit}"
    # corners are where dark and bright meet
    polarity = "" if setup.extract.method == "corners" else f" ({setup.extract.polarity})"
    return f"{setup.extract.method}{polarity}, sigma {setup.extract.sigma:g} {unit}"


def _say_accuracy(report: _Report, session: Session) -> None:
    """Report features in view, expected accuracy, and poses that look alike."""
    if session.start is not None:
        _say_accuracy_at(report, session, [session.start.T_world_object], "at [start]")
        return
    depends_on_distance = placement.depends_on_distance(session)
    for away in _AWAY if depends_on_distance else _AWAY[:1]:
        poses = placement.typical_poses(session, _TYPICAL_POSES, away=away)
        if not poses:
            report.say("start", "none, and no place is in view of the sensors: add [start]")
            return
        where = "in the middle of the sensors' common view"
        if depends_on_distance:
            middle = transform(np.array(poses), session.body.means.mean(axis=0)[None])[:, 0]
            distance = np.linalg.norm(session.sensors[0].sensor.towards(middle), axis=1).mean()
            where = f"{float(f'{distance:.3g}'):g} {session.unit} away"
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
    """Report accuracy at poses (4, 4); return whether other poses look like one of them."""
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
    ambiguous = [
        alike
        for T, (covariance, _) in zip(poses, expected, strict=True)
        if np.isfinite(np.diag(covariance)).all()
        and (alike := lookalikes.look_alikes(session.sensors, session.body, T, free))
    ]
    if ambiguous:
        report.warn(_look_alike_text(session, ambiguous, len(poses), where))
    return bool(ambiguous)


def _look_alike_text(
    session: Session, ambiguous: list[list[lookalikes.LookAlike]], tried: int, where: str
) -> str:
    best = min((alike[0] for alike in ambiguous), key=lambda alike: alike.difference)
    orientations = f" in {len(ambiguous)} of {tried} orientations" if tried > 1 else ""
    count = max(map(len, ambiguous))
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
        f"{name} {value:.3g} {unit_name}" if np.isfinite(value) else f"{name} not determined"
        for name, value, unit_name, is_free in zip(
            TWIST_NAMES, deviations * scale, units, free, strict=True
        )
        if is_free
    )

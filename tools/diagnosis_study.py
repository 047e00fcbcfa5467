"""Which known faults `mixpose check` names, put one at a time into sessions that are right.

    python tools/diagnosis_study.py SESSION.toml ... [--instead SESSION.toml ...]
                                    [--right SESSION.toml ...] [--fault NAME ...]

A line for each session and fault, then a table of all.  A fault that a session cannot have, such
as the other polarity where corners are given in a table, is put into the first session of
`--instead` that can have it and was not given it before.  Whatever is said of a session without a
fault, those of `--right` among them, is a false alarm.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.checking import key_warnings, with_image_sizes
from mixpose.checking.geometry import geometry_doubts
from mixpose.checking.placement import placement_warnings
from mixpose.checking.recordings import Survey, frames_to_count, survey
from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.runner import open_sources
from mixpose.session import Session, load_session

Surveys: TypeAlias = dict[tuple[str, str, str], Survey]

_NONE = "none"


def with_points(session: Session, points: Floats, normals: Floats | None) -> Session:
    features = tuple(PointFeature(point) for point in points)
    body: Body = replace(session.body, features=features, normals=normals)
    return replace(session, body=body, start=None)


def mirrored(session: Session) -> Session:
    side, normals = np.array([1.0, -1.0, 1.0]), session.body.normals
    turned = None if normals is None else normals * side
    return with_points(session, session.body.means * side, turned)


def larger(session: Session, factor: float) -> Session | None:
    """A body of another size; one camera sees none."""
    if len(session.sensors) < 2:
        return None
    other = with_points(session, factor * session.body.means, session.body.normals)
    radii = session.body.radii
    scaled = replace(other.body, radii=None if radii is None else factor * radii)
    return replace(other, body=scaled)


def turned_inwards(session: Session) -> Session | None:
    normals = session.body.normals
    return None if normals is None else with_points(session, session.body.means, -normals)


def moved_marker(session: Session) -> int:
    return len(session.body.means) // 4


def one_marker_off(session: Session) -> Session:
    points, k = np.array(session.body.means), moved_marker(session)
    points[k] += np.array([3e-3, -4e-3, 0]) / session.metres_per_unit
    return with_points(session, points, session.body.normals)


def of_cameras(session: Session, change: Callable[[Any], Any]) -> Session:
    setups = [replace(setup, sensor=change(setup.sensor)) for setup in session.sensors]
    return replace(session, sensors=tuple(setups))


def flipped(sensor: Any) -> Any:
    """A camera that takes its images for mirrored ones."""
    K = np.array(sensor.camera_matrix)
    K[0, :2], K[0, 2] = -K[0, :2], sensor.resolution[0] - 1 - K[0, 2]
    return replace(sensor, camera_matrix=K)


def halved(sensor: Any) -> Any:
    return replace(sensor, camera_matrix=sensor.camera_matrix * [[0.5], [0.5], [1.0]])


def without_distortion(session: Session) -> Session | None:
    bent = any(np.any(setup.sensor.distortion) for setup in session.sensors)  # type: ignore[attr-defined]
    return of_cameras(session, lambda s: replace(s, distortion=np.zeros(0))) if bent else None


def inverted(session: Session) -> Session | None:
    if len(session.sensors) < 2:
        return None
    return of_cameras(session, lambda s: replace(s, T_sensor_world=inverse(s.T_sensor_world)))


def swapped(session: Session) -> Session | None:
    if len(session.sensors) < 2:
        return None
    a, b, *rest = session.sensors
    a, b = replace(a, source=b.source), replace(b, source=a.source)
    return replace(session, sensors=(a, b, *rest))


def copied(session: Session) -> Session | None:
    if len(session.sensors) < 2:
        return None
    a, b, *rest = session.sensors
    other: Any = b.sensor
    lens: dict[str, Any] = {
        key: getattr(other, key).copy() for key in ("camera_matrix", "distortion")
    }
    return replace(session, sensors=(replace(a, sensor=replace(a.sensor, **lens)), b, *rest))  # type: ignore[type-var]


def of_other_polarity(session: Session) -> Session | None:
    if any(str(s.source).endswith(".csv") for s in session.sensors):
        return None
    if any(s.extract.method == "corners" for s in session.sensors):
        return None  # dark and bright meet in corners
    is_bright = session.sensors[0].extract.polarity == "bright"
    other: Literal["dark", "bright"] = "dark" if is_bright else "bright"
    setups = [replace(s, extract=replace(s.extract, polarity=other)) for s in session.sensors]
    return replace(session, sensors=tuple(setups))


@dataclass(frozen=True)
class Fault:
    """What is wrong, and what names it of a session that is right (a regular expression)."""

    put_in: Callable[[Session], Session | None]
    named: Callable[[Session], str]


def first(session: Session, k: int = 0) -> str:
    return repr(session.sensors[k].name)


VERB = "(is|are|may be)"
FAULTS: dict[str, Fault] = {
    "body mirrored": Fault(mirrored, lambda _: rf"the body of .*{VERB} mirrored"),
    "points in metres": Fault(
        lambda s: larger(s, 1e-3), lambda _: r"two units of length.*with points 1000 times as large"
    ),
    "body 2 % too large": Fault(
        lambda s: larger(s, 1.02), lambda _: r"size that was seen.*with points 0\.9[78]\d* times"
    ),
    "T_sensor_world inverted": Fault(inverted, lambda _: rf"T_sensor_world of .* {VERB} inverted"),
    "sources swapped": Fault(swapped, lambda s: rf"{first(s)} and {first(s, 1)} {VERB} swapped"),
    "images flipped": Fault(
        lambda s: of_cameras(s, flipped), lambda _: rf"images of .* {VERB} mirrored"
    ),
    "distortion left out": Fault(
        without_distortion, lambda _: rf"distortion of .* {VERB} left out"
    ),
    "camera_matrix halved": Fault(
        lambda s: of_cameras(s, halved),
        lambda _: rf"camera_matrix of .* {VERB} that of images half",
    ),
    "other polarity": Fault(
        of_other_polarity, lambda s: f'polarity = "{s.sensors[0].extract.polarity}"'
    ),
    "normals inwards": Fault(turned_inwards, lambda _: rf"normals of .* {VERB} of the wrong sign"),
    "marker 5 mm off": Fault(
        one_marker_off,
        lambda s: rf"marker {re.escape(s.body.labels[moved_marker(s)])} of .* measured wrong",
    ),
    "calibration of another": Fault(
        copied, lambda s: rf"the calibration of {first(s)} {VERB} not that of its images"
    ),
}


@dataclass(frozen=True)
class Row:
    """One session with one fault, or with none."""

    session: str
    fault: str
    is_right: bool
    said: str
    seconds: float

    @property
    def verdict(self) -> str:
        return "ok" if self.is_right else "NO"

    def line(self) -> str:
        return (
            f"{self.verdict}  {self.fault:<24} {self.seconds:5.1f} s  {self.session}: {self.said}\n"
        )


def said_of(session: Session, known: Surveys) -> tuple[list[str], float]:
    """What is said of a session beside its counts, and how long the trials took.

    Frames are counted once for all that would find the same in them.
    """
    sources = open_sources(session, {})
    surveys = {}
    for setup in session.sensors:
        key = (str(session.path), str(setup.source), repr(setup.extract))
        if key not in known:
            known[key] = survey(
                session, setup, sources[setup.name], to_count=frames_to_count(sources)
            )
        surveys[setup.name] = known[key]
    sized = with_image_sizes(session, {name: each.size for name, each in surveys.items()})
    began = time.process_time()
    doubts = geometry_doubts(session, sources, surveys)
    seconds = time.process_time() - began
    return [*doubts.warnings, *key_warnings(sized), *placement_warnings(sized)], seconds


def loaded(path: str) -> Session:
    """A session whose cameras know the size of their images."""
    session = load_session(Path(path))
    sources = open_sources(session, {})
    sizes = {s.name: survey(session, s, sources[s.name], quick=True).size for s in session.sensors}
    return with_image_sizes(session, sizes)


def row(path: str, session: Session, fault: str, known: Surveys) -> Row | None:
    """What is said of a session with a fault; None where it cannot have that."""
    wrong = session if fault == _NONE else FAULTS[fault].put_in(session)
    if wrong is None:
        return None
    said, seconds = said_of(wrong, known)
    text = "; ".join(said)
    is_right = not said if fault == _NONE else bool(re.search(FAULTS[fault].named(session), text))
    return Row(path, fault, is_right, text or "nothing", seconds)


def rows_of(options: argparse.Namespace) -> Iterator[tuple[str, Row]]:
    """Rows, each with the session in whose column it is."""
    known: Surveys = {}
    every = dict.fromkeys([*options.sessions, *options.instead, *options.right])
    sessions = {path: loaded(path) for path in every}
    for fault in options.fault or [_NONE, *FAULTS]:
        given = set(options.sessions)
        for path in options.sessions:
            others = [each for each in options.instead if each not in given]
            for other in [path, *(others if fault != _NONE else ())]:
                if (found := row(other, sessions[other], fault, known)) is not None:
                    given.add(other)
                    yield path, found
                    break
    for path in () if options.fault else options.right:
        if (found := row(path, sessions[path], _NONE, known)) is not None:
            yield path, found


def table_of(rows: Sequence[tuple[str, Row]], columns: Sequence[str]) -> Iterator[str]:
    """Sessions beside each other, a line for each fault, and how many were named."""
    numbers = {path: str(k) for k, path in enumerate(dict.fromkeys(r.session for _, r in rows), 1)}
    yield from (f"{number:>3}  {path}" for path, number in numbers.items())
    cells = {(path, one.fault): one for path, one in rows}
    for fault in [_NONE, *FAULTS]:
        found = [cells.get((path, fault)) for path in columns]
        if any(found):
            marks = [f"{numbers[o.session]:>4} {o.verdict:<3}" if o else f"{'-':>8}" for o in found]
            yield f"{fault:<24}{''.join(marks)}"
    faulty = [one for _, one in rows if one.fault != _NONE]
    faultless = [one for _, one in rows if one.fault == _NONE]
    named, alarms = sum(one.is_right for one in faulty), sum(not one.is_right for one in faultless)
    unsure = sum(one.is_right and " may be " in one.said for one in faulty)
    yield (
        f"named rightly: {named} of {len(faulty)}, {unsure} of them beside another that is as "
        f"good; false alarms: {alarms} of {len(faultless)}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sessions", nargs="*", metavar="SESSION.toml")
    parser.add_argument("--instead", nargs="*", default=[], metavar="SESSION.toml")
    parser.add_argument("--right", nargs="*", default=[], metavar="SESSION.toml")
    parser.add_argument("--fault", nargs="*", choices=[_NONE, *FAULTS], help="these only")
    options = parser.parse_args()
    rows = []
    for column, found in rows_of(options):
        rows.append((column, found))
        sys.stdout.write(found.line())
        sys.stdout.flush()
    sys.stdout.write("\n".join(table_of(rows, options.sessions)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

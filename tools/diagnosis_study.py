"""What `mixpose check` says of sessions into which known faults are put, fault by fault.

    python tools/diagnosis_study.py SESSION.toml ...

The sessions should be right.  Faults that a session cannot have are left out.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.checking import geometry_doubts, survey
from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.runner import open_sources
from mixpose.session import Session, load_session


def with_points(session: Session, points: Floats, normals: Floats | None) -> Session:
    features = tuple(PointFeature(point) for point in points)
    return replace(session, body=Body(session.body.name, features, normals), start=None)


def larger(factor: float) -> Callable[[Session], Session]:
    return lambda s: with_points(s, factor * s.body.means, s.body.normals)


def mirrored(session: Session) -> Session:
    side, normals = np.array([1.0, -1.0, 1.0]), session.body.normals
    turned = None if normals is None else normals * side
    return with_points(session, session.body.means * side, turned)


def turned_inwards(session: Session) -> Session | None:
    normals = session.body.normals
    return None if normals is None else with_points(session, session.body.means, -normals)


def one_marker_off(session: Session) -> Session:
    points = np.array(session.body.means)
    points[len(points) // 4] += [3e-3 / session.metres_per_unit, -4e-3 / session.metres_per_unit, 0]
    return with_points(session, points, session.body.normals)


def of_cameras(change: Callable[[Any], Any]) -> Callable[[Session], Session]:
    def changed(session: Session) -> Session:
        setups = [replace(setup, sensor=change(setup.sensor)) for setup in session.sensors]
        return replace(session, sensors=tuple(setups))

    return changed


def flipped(sensor: Any) -> Any:
    """A camera that takes its images for mirrored ones."""
    K = np.array(sensor.camera_matrix)
    K[0, :2], K[0, 2] = -K[0, :2], sensor.resolution[0] - 1 - K[0, 2]
    return replace(sensor, camera_matrix=K)


def halved(sensor: Any) -> Any:
    return replace(sensor, camera_matrix=sensor.camera_matrix * [[0.5], [0.5], [1.0]])


def inverted(session: Session) -> Session | None:
    turn = of_cameras(lambda s: replace(s, T_sensor_world=inverse(s.T_sensor_world)))
    return turn(session) if len(session.sensors) > 1 else None


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
    camera, other = (setup.sensor for setup in (a, b))
    lens: dict[str, Any] = {
        key: getattr(other, key).copy() for key in ("camera_matrix", "distortion")
    }
    return replace(session, sensors=(replace(a, sensor=replace(camera, **lens)), b, *rest))  # type: ignore[type-var]


def of_other_polarity(session: Session) -> Session | None:
    if any(str(setup.source).endswith(".csv") for setup in session.sensors):
        return None
    is_bright = session.sensors[0].extract.polarity == "bright"
    other: Literal["dark", "bright"] = "dark" if is_bright else "bright"
    setups = [replace(s, extract=replace(s.extract, polarity=other)) for s in session.sensors]
    return replace(session, sensors=tuple(setups))


FAULTS: dict[str, Callable[[Session], Session | None]] = {
    "none": lambda session: session,
    "body mirrored": mirrored,
    "points in metres": larger(1e-3),
    "body 2 % too large": larger(1.02),
    "T_sensor_world inverted": inverted,
    "sources swapped": swapped,
    "images flipped": of_cameras(flipped),
    "distortion left out": of_cameras(lambda s: replace(s, distortion=np.zeros(0))),
    "camera_matrix halved": of_cameras(halved),
    "other polarity": of_other_polarity,
    "normals inwards": turned_inwards,
    "marker 5 mm off": one_marker_off,
    "calibration of another": copied,
}


def said_of(session: Session) -> str:
    sources = open_sources(session, {})
    surveys = {s.name: survey(session, s, sources[s.name]) for s in session.sensors}
    return "; ".join(geometry_doubts(session, sources, surveys).warnings) or "nothing"


def main(paths: list[str]) -> None:
    for path in paths:
        session = load_session(Path(path))
        sys.stdout.write(f"{path}\n")
        for name, fault in FAULTS.items():
            began, wrong = time.process_time(), fault(session)
            said = "not applicable" if wrong is None else said_of(wrong)
            sys.stdout.write(f"  {name:<24} {time.process_time() - began:5.1f} s  {said}\n")


if __name__ == "__main__":
    main(sys.argv[1:])

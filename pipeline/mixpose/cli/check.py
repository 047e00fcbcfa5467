"""``mixpose check``: what a session says, without estimating anything."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mixpose.body import symmetries
from mixpose.estimation import expected_covariance, free_mask
from mixpose.rigid import TWIST_NAMES, transform
from mixpose.runner import open_sources
from mixpose.session import SensorSetup, Session, load_session

_NOISE_OF_SIGMA = 0.2  # what centres of blobs err by, of σ_ε


def check_session(path: Path) -> None:
    """Print sensors, recordings, the object's symmetries and the expected accuracy.

    Raises
    ------
    SessionError, RecordingError
        As ``mixpose run`` would before its first frame.
    """
    session = load_session(path)
    lines = [f"session   {session.path}, lengths in {session.unit}"]
    lines += _object_lines(session)
    sources = open_sources(session, {})
    for setup in session.sensors:
        lines.append(f"sensor    {setup.name}: {_geometry(setup)}, {_extraction(setup)}")
        lines.append(f"          {sources[setup.name].describe()}")
    lines += _accuracy_lines(session)
    sys.stdout.write("\n".join(lines) + "\n")


def _object_lines(session: Session) -> list[str]:
    body = session.body
    spread = f", spread up to {body.spread:g} {session.unit}" if body.spread else ", exact"
    extent = f"{len(body)} features within {body.radius:.4g} {session.unit} of their centre"
    lines = [f"object    {body.name}: {extent}{spread}"]
    alike = len(body.symmetries)
    if alike > 1:
        lines.append(
            f"symmetry  {alike} orientations look the same; the pose nearest to the previous one "
            "is written"
        )
    else:
        lines.append("symmetry  none")
    return lines + _near_symmetry_lines(session)


def _near_symmetry_lines(session: Session) -> list[str]:
    """A warning where the body almost maps onto itself, as far as the sensors can tell."""
    blur = _blur_at_start(session)
    body = session.body
    if blur is None or blur <= 0:
        return []
    alike = len(symmetries(body.nodes.points, blur))
    if alike <= len(body.symmetries):
        return []
    return [
        f"warning   {alike} orientations look the same within {blur:.3g} {session.unit}, three "
        "times the error of a feature: expect frames that are ambiguous, or move a marker"
    ]


def _blur_at_start(session: Session) -> float | None:
    """Three times the error of a feature at the start, in length units, in the best sensor."""
    if session.start is None:
        return None
    points = transform(session.start.T_world_object, session.body.means)
    blurs = []
    for setup in session.sensors:
        _, J, seen = setup.sensor.linearise(points)
        if seen.any():
            largest = np.linalg.norm(J[seen], axis=2).mean()
            blurs.append(3 * setup.extract.sigma * _NOISE_OF_SIGMA / float(largest))
    return min(blurs, default=None)


def _geometry(setup: SensorSetup) -> str:
    if setup.resolution is None:
        return setup.model
    return f"{setup.model} {setup.resolution[0]}x{setup.resolution[1]}"


def _extraction(setup: SensorSetup) -> str:
    unit = "px" if setup.sensor.unit == "px" else "length units"
    if setup.model == "lateration":
        return f"sigma {setup.extract.sigma:g} {unit}"
    return (
        f"{setup.extract.method} ({setup.extract.polarity}), sigma {setup.extract.sigma:g} {unit}"
    )


def _accuracy_lines(session: Session) -> list[str]:
    if session.start is None:
        return ["start     none: the first pose is searched for; with one, accuracy is predicted"]
    free = free_mask(session.estimator)
    covariance, counts = expected_covariance(
        [setup.sensor for setup in session.sensors],
        [setup.extract.sigma for setup in session.sensors],
        session.body,
        session.start.T_world_object,
        free,
    )
    seen = ", ".join(
        f"{setup.name} {count}/{len(session.body)}"
        for setup, count in zip(session.sensors, counts, strict=True)
    )
    deviations = np.sqrt(np.diag(covariance))
    deviations[3:] = np.degrees(deviations[3:])
    units = [session.unit] * 3 + ["deg"] * 3
    terms = [
        _deviation(name, value, unit)
        for name, value, unit, is_free in zip(TWIST_NAMES, deviations, units, free, strict=True)
        if is_free
    ]
    return [
        f"in view   at the start: {seen}",
        f"accuracy  one standard deviation at the start, if each feature errs by sigma: "
        f"{', '.join(terms)}",
    ]


def _deviation(name: str, value: float, unit: str) -> str:
    if not np.isfinite(value):
        return f"{name} not determined"
    return f"{name} {value:.3g} {unit}"

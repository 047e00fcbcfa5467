"""What is odd about a session by itself: keys of single sensors, sources and bodies given twice."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import combinations

import numpy as np

from mixpose.body import LookAlike, congruent_parts
from mixpose.checking.lookalikes import noise_of
from mixpose.checking.placement import typical_poses
from mixpose.frames import files_of
from mixpose.runner import source_spec
from mixpose.sensors import FisheyeCamera, PinholeCamera, RangeSensor
from mixpose.session import Session

_OFF_CENTRE = 0.25  # of the image: lenses are centred better, crops and other sizes often are not
_NOISES = 3.0  # standard deviations that markers may be off each other
_LEAST = 0.01  # of the smaller body's radius: nearer than this they are the same


def key_warnings(session: Session) -> list[str]:
    """What is most likely wrong about calibrations and widths; images have their recorded sizes."""
    return _off_centre(session) + _too_wide(session)


def _off_centre(session: Session) -> list[str]:
    """Principal points far from the middle: a calibration of images of another size."""
    warnings = []
    for setup in session.sensors:
        sensor = setup.sensor
        if not isinstance(sensor, PinholeCamera | FisheyeCamera) or sensor.resolution is None:
            continue
        size = np.array(sensor.resolution)
        cx, cy = sensor.camera_matrix[:2, 2]
        if (np.abs((cx, cy) - (size - 1) / 2) > _OFF_CENTRE * size).any():
            warnings.append(
                f"sensor {setup.name!r}: the principal point cx = {cx:g}, cy = {cy:g} is far from "
                f"the middle of its images of {size[0]}x{size[1]} px: is the calibration of images "
                "of another size, and camera_matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]?"
            )
    return warnings


def _too_wide(session: Session) -> list[str]:
    """Ranges given a width in which the whole body disappears, as by the default for pixels."""
    names = [
        f"{setup.name!r}"
        for setup in session.sensors
        if isinstance(setup.sensor, RangeSensor) and setup.extract.sigma > session.body.radius
    ]
    if not names:
        return []
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    sigma = max(s.extract.sigma for s in session.sensors if isinstance(s.sensor, RangeSensor))
    return [
        f"sensor {names[0]}{more}: sigma = {sigma:g} {session.unit} in [extract] is wider than "
        f"the body, whose features lie within {session.body.radius:.2g} {session.unit}: set it to "
        "about what ranges err by"
    ]


def shared_source_warnings(session: Session, replaced: Mapping[str, str]) -> list[str]:
    """Pairs of sensors that read the same recording, some of which are `replaced` by name."""
    read = {
        setup.name: {
            os.path.realpath(place) if os.path.exists(place) else place  # noqa: PTH110 - or an address
            for place in files_of(source_spec(session, setup, replaced.get(setup.name)))
        }
        for setup in session.sensors
    }
    warnings = []
    for (a, own), (b, others) in combinations(read.items(), 2):
        both = own & others
        if both:
            first = os.path.basename(min(both))  # noqa: PTH119 - of an address too
            files = first if len(both) == 1 else f"{len(both)} files ({first}, ...)"
            warnings.append(
                f"sensors {a!r} and {b!r} read the same recording, {files}: give each its own "
                "source"
            )
    return warnings


def shared_part_warnings(session: Session) -> list[str]:
    """Pairs of bodies that are congruent within the noise, or whose largest such parts are."""
    warnings = list[str]()
    if len(session.objects) < 2:
        return warnings
    noise = _noise_length(session)
    for one, other in combinations([each.body for each in session.objects], 2):
        least = _LEAST * min(one.radius, other.radius)
        parts = congruent_parts(one, other, max(least, _NOISES * noise, one.spread, other.spread))
        if parts:
            warnings.append(_text(parts[0], session.unit))
    return warnings


def _noise_length(session: Session) -> float:
    """What markers err by in the world, where the bodies are about: the best of the sensors."""
    lengths = []
    for setup in session.sensors:
        if setup.sensor.dimension == 1:
            lengths.append(noise_of(setup))
            continue
        if any(s.sensor.dimension == 2 and s.resolution is None for s in session.sensors):
            continue
        for T in typical_poses(session, 1)[:1]:
            _, J, seen = setup.sensor.linearise(session.body.means @ T[:3, :3].T + T[:3, 3])
            if seen.all():
                lengths.append(noise_of(setup) / max(float(np.linalg.norm(J[0], 2)), 1e-12))
    return min(lengths, default=0.0)


def _text(part: LookAlike, unit: str) -> str:
    one, other = part.body, part.other
    pairs = ", ".join(f"{i} like {j}" for i, j in zip(part.features, part.partners, strict=True))
    if len(part.features) == len(one) == len(other):
        return (
            f"the bodies {one.name!r} and {other.name!r} are congruent to {part.off:.2g} {unit} "
            f"(markers {pairs}): nothing tells them apart; give one [[object]] with count, or move "
            "a marker"
        )
    return (
        f"{len(part.features)} markers of {one.name!r} lie like {len(part.features)} of "
        f"{other.name!r} to "
        f"{part.off:.2g} {unit} ({pairs}): where the others are hidden the one may be the other; "
        "expect ambiguous frames, or move a marker"
    )

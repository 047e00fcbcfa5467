"""Keys of single sensors whose values can hardly be meant."""

from __future__ import annotations

import numpy as np

from mixpose.sensors import FisheyeCamera, PinholeCamera, RangeSensor
from mixpose.session import Session

_OFF_CENTRE = 0.25  # of the image: lenses are centred better, crops and other sizes often are not


def key_warnings(session: Session) -> list[str]:
    """What is most likely wrong about calibrations and widths, a line each.

    The session knows the sizes of the recorded images.
    """
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

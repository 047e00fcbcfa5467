"""Clouds of points as views for an objective, and their reports as those of one sensor.

A cloud is seen in three images (`mixpose.sensors.cloud`), each of them a view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from mixpose.objective import View
from mixpose.records import Estimate, Floats, Offsets, PointPattern, SensorReport, replace
from mixpose.sensors import PLANES, CloudSensor


def plane_names(name: str) -> list[str]:
    """Return the names of the views of a cloud."""
    return [f"{name}/{axes}" for axes, _ in PLANES]


def plane_views(view: View) -> list[View]:
    """Return the views for an objective: three images of a cloud; for others the view itself."""
    if not isinstance(view.sensor, CloudSensor):
        return [view]
    seen, pattern = view.observation, view.observation.pattern
    assert isinstance(pattern, PointPattern)
    return [
        View(
            name,
            plane,
            replace(seen, pattern=replace(pattern, points=pattern.points[:, axes])),
            view.delay,
        )
        for name, plane, (_, axes) in zip(
            plane_names(view.name), view.sensor.planes, PLANES, strict=True
        )
    ]


def with_clouds(estimate: Estimate, clouds: Mapping[str, CloudSensor]) -> Estimate:
    """Return an estimate with reports and offsets of clouds in place of those of their views."""
    if not clouds:
        return estimate
    reports = dict(estimate.sensors)
    for name in clouds:
        planes = [reports.pop(plane) for plane in plane_names(name) if plane in reports]
        if planes:
            reports[name] = _report(planes)
    return replace(estimate, sensors=reports, measured=partial(_offsets, estimate.measured, clouds))


def _report(planes: Sequence[SensorReport]) -> SensorReport:
    """Return the report of a cloud from those of its images; distances are those in space."""
    explained = [plane.explained for plane in planes if plane.explained is not None]
    labels = set.intersection(*[set(plane.residuals) for plane in planes])
    return SensorReport(
        any(plane.used for plane in planes),
        sum(explained) / len(explained) if explained else None,
        _length([plane.rms for plane in planes]),
        next((plane.why for plane in planes if not plane.used and plane.why), None),
        {
            label: _length([plane.residuals[label] for plane in planes])
            for label in planes[0].residuals
            if label in labels
        },
    )


def _length(planes: Sequence[float | None]) -> float | None:
    """Return a distance in space by those in three images, each coordinate being in two."""
    known = [distance for distance in planes if distance is not None]
    if len(known) < len(planes):
        return None
    return float(np.sqrt(np.square(known).sum() / 2))


def _offsets(
    measured: Callable[[], Mapping[str, Offsets]], clouds: Mapping[str, CloudSensor]
) -> Mapping[str, Offsets]:
    """Return the offsets of all sensors, of clouds in space."""
    offsets = dict(measured())
    for name, sensor in clouds.items():
        planes = [offsets.pop(plane) for plane in plane_names(name) if plane in offsets]
        if len(planes) == len(PLANES):
            offsets[name] = _in_space(planes, sensor)
    return offsets


def _in_space(planes: Sequence[Offsets], sensor: CloudSensor) -> Offsets:
    """Return offsets along the three axes, each the mean of those in two images."""
    n = len(planes[0].features)
    offsets, observed = np.zeros((n, 3)), np.zeros((n, 3))
    for plane, (_, axes) in zip(planes, PLANES, strict=True):
        offsets[:, axes] += plane.offsets / 2
        observed[:, axes] += plane.observed / 2
    by_shift: Floats = np.broadcast_to(sensor.T_sensor_world[:3, :3], (n, 3, 3))
    met = np.logical_and.reduce([plane.met for plane in planes])
    shared = np.logical_or.reduce([plane.shared for plane in planes])
    weights = np.minimum.reduce([plane.weights for plane in planes])
    return Offsets(planes[0].features, met, offsets, by_shift, observed, shared, weights)

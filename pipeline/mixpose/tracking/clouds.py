"""Clouds of points as the views that an objective knows; what is told of them, as of one sensor.

A cloud is seen in three images (`mixpose.sensors.cloud`), each of them a view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mixpose.objective import View
from mixpose.records import Estimate, Floats, Offsets, PointPattern, SensorReport
from mixpose.sensors import PLANES, CloudSensor


def plane_names(name: str) -> list[str]:
    """What the views of a cloud are called."""
    return [f"{name}/{axes}" for axes, _ in PLANES]


def plane_views(view: View) -> list[View]:
    """What an objective knows of a view: three images of a cloud, of others the view itself."""
    if not isinstance(view.sensor, CloudSensor):
        return [view]
    seen, pattern = view.observation, view.observation.pattern
    assert isinstance(pattern, PointPattern)
    return [
        View(
            called,
            plane,
            replace(seen, pattern=replace(pattern, points=pattern.points[:, axes])),
            view.delay,
        )
        for called, plane, (_, axes) in zip(
            plane_names(view.name), view.sensor.planes, PLANES, strict=True
        )
    ]


def with_clouds(estimate: Estimate, clouds: Mapping[str, CloudSensor]) -> Estimate:
    """An estimate with reports and offsets of clouds by name, in place of those of their views."""
    if not clouds:
        return estimate
    reports = dict(estimate.sensors)
    for name in clouds:
        own = [reports.pop(each) for each in plane_names(name) if each in reports]
        if own:
            reports[name] = _report(own)
    return replace(estimate, sensors=reports, measured=partial(_offsets, estimate.measured, clouds))


def _report(planes: Sequence[SensorReport]) -> SensorReport:
    """How a cloud took part, by how its images did; distances are those in space."""
    explained = [one.explained for one in planes if one.explained is not None]
    labels = set.intersection(*[set(one.residuals) for one in planes])
    return SensorReport(
        any(one.used for one in planes),
        sum(explained) / len(explained) if explained else None,
        _length([one.rms for one in planes]),
        next((one.why for one in planes if not one.used and one.why), None),
        {
            label: _length([one.residuals[label] for one in planes])
            for label in planes[0].residuals
            if label in labels
        },
    )


def _length(planes: Sequence[float | None]) -> float | None:
    """A distance in space by those in the three images, where each coordinate is in two."""
    known = [one for one in planes if one is not None]
    if len(known) < len(planes):
        return None
    return float(np.sqrt(np.square(known).sum() / 2))


def _offsets(
    measured: Callable[[], Mapping[str, Offsets]], clouds: Mapping[str, CloudSensor]
) -> Mapping[str, Offsets]:
    """Offsets of all sensors, of clouds in space."""
    offsets = dict(measured())
    for name, sensor in clouds.items():
        own = [offsets.pop(each) for each in plane_names(name) if each in offsets]
        if len(own) == len(PLANES):
            offsets[name] = _in_space(own, sensor)
    return offsets


def _in_space(planes: Sequence[Offsets], sensor: CloudSensor) -> Offsets:
    """Offsets along the three axes, each the mean of those in two images."""
    n = len(planes[0].features)
    away, observed = np.zeros((n, 3)), np.zeros((n, 3))
    for one, (_, axes) in zip(planes, PLANES, strict=True):
        away[:, axes] += one.offsets / 2
        observed[:, axes] += one.observed / 2
    by_shift: Floats = np.broadcast_to(sensor.T_sensor_world[:3, :3], (n, 3, 3))
    met = np.logical_and.reduce([one.met for one in planes])
    shared = np.logical_or.reduce([one.shared for one in planes])
    weights = np.minimum.reduce([one.weights for one in planes])
    return Offsets(planes[0].features, met, away, by_shift, observed, shared, weights)

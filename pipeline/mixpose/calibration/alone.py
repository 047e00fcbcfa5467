"""Where the body is for one camera alone: several answers where several fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.calibration.rules import CalibrationRules
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import inverse
from mixpose.sensors import CloudSensor, Sensor
from mixpose.tracking import Tracker, plane_views

_LEAST = 4  # detections: three leave four poses of any triangle


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Poses that explain what one sensor saw."""

    poses: Floats  # (H, 4, 4): T_sensor_object, most evident first; none where nothing convinces
    evidence: Floats  # (H,): log-odds against clutter


NOTHING = Hypotheses(np.zeros((0, 4, 4)), np.zeros(0))


def hypotheses(
    name: str, sensor: Sensor, points: Floats, sigma: float, body: Body, rules: CalibrationRules
) -> Hypotheses:
    """Search for the body in one camera's frame.

    Parameters
    ----------
    sensor : Sensor
        A camera.
    points : (M, 2) array
        Its detections.
    sigma : float
        σ_ε.
    """
    if len(points) < _LEAST:
        return NOTHING
    # the world is put where the camera is, so that poses are relative to it
    own = sensor.moved(inverse(sensor.T_sensor_world))  # type: ignore[attr-defined]
    pattern = PointPattern(points, np.ones(len(points)))
    seen = Observation(pattern, sigma)
    views = [View(name, own, seen)]
    if isinstance(own, CloudSensor):
        views = plane_views(name, own, seen, 0.0)
    tracker = Tracker.create(body, EstimatorOptions())
    frame = tracker.data(tracker.begin(), 0, None, views)
    ranked = tracker.explain(frame)
    best = ranked[0].log_evidence if ranked else 0.0
    kept = [one for one in ranked if one.log_evidence > max(best - rules.margin, 0.0)]
    kept = kept[: rules.hypotheses]
    if not kept:
        return NOTHING
    poses = np.array([one.T_world_object for one in kept])
    return Hypotheses(poses, np.array([one.log_evidence for one in kept]))

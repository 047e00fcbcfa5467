"""One body alone: from frame to frame, or a single pose."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mixpose.body import Body
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Estimate, Floats
from mixpose.rigid import is_rigid
from mixpose.threads import one_blas_thread
from mixpose.tracking.scene import Outcome, Scene
from mixpose.tracking.track import Track
from mixpose.tracking.tracked_body import TrackedBody


class Tracker(TrackedBody):
    """A body that is tracked, by itself or in a `Scene`."""

    def advance(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> Outcome:
        """Estimate one frame, in a scene that has no other body; see `Scene.advance`."""
        return Scene((self,)).advance((track,), frame, time_s, views)[0]


def estimate_pose(
    views: Sequence[View],
    model: Body,
    start: Floats | None = None,
    options: EstimatorOptions | None = None,
) -> Estimate:
    """Estimate one pose.

    Parameters
    ----------
    views : sequence of View
        Sensors with what they observed.
    model : Body
    start : (4, 4) array or None
        T_world_object near the pose; without it the pose is searched for everywhere.
    options : EstimatorOptions or None

    Returns
    -------
    Estimate
        Of frame 0.

    Raises
    ------
    ValueError
        If the start is no rigid motion, or a view's features are not of its sensor's dimension.
    """
    if start is not None and not (np.shape(start) == (4, 4) and is_rigid(np.asarray(start))):
        raise ValueError("start: not a rotation and a translation as one 4x4 matrix")
    for view in views:
        found, allowed = view.observation.dimension, view.sensor.dimension
        if found != allowed:
            raise ValueError(
                f"view {view.name!r}: features of {found} coordinates; its sensor has {allowed}"
            )
    tracker = Tracker.create(model, options or EstimatorOptions(), start)
    began = time.perf_counter()
    with one_blas_thread():
        _, estimate = tracker.advance(tracker.begin(), 0, None, views)
    return replace(estimate, latency_ms=1e3 * (time.perf_counter() - began))

"""A body that is tracked, in a scene or alone; and a single pose."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, free_mask
from mixpose.objective import View
from mixpose.records import Estimate, Floats, Mask, label_of
from mixpose.rigid import is_rigid
from mixpose.threads import one_blas_thread
from mixpose.tracking.in_motion import is_timed
from mixpose.tracking.likelihood import FrameData
from mixpose.tracking.motion import per_kind
from mixpose.tracking.proposers import PROPOSERS, REFINEMENTS, Proposer, Refinement
from mixpose.tracking.rules import Rules
from mixpose.tracking.scene import Scene
from mixpose.tracking.track import Branch, Prediction, Track, predict


@dataclass(frozen=True)
class Tracker:
    """A body, and how its poses are estimated: what stays the same from frame to frame."""

    body: Body
    options: EstimatorOptions
    samples: Floats  # (N, R, 3), of the body, for the objectives that integrate by sampling
    start_uncertainty: Floats  # (6,)
    T_start: Floats | None = None  # (4, 4)
    rules: Rules = Rules()
    proposers: tuple[Proposer, ...] = PROPOSERS  # as tried; the first: where it is expected
    refinements: tuple[Refinement, ...] = REFINEMENTS
    instance: int | None = None  # which of identical bodies, of the same `Body`; None: only one

    @classmethod
    def create(
        cls,
        body: Body,
        options: EstimatorOptions,
        T_start: Floats | None = None,
        *,
        rotation_deg: float | None = None,
        distance: float | None = None,
        rules: Rules = Rules(),
        instance: int | None = None,
    ) -> Self:
        """Prepare tracking, from about T_start (4, 4) within half-widths, or those of the rules."""
        motion = rules.motion
        start = per_kind(body, motion.start_distance, motion.start_rotation_deg)
        if distance is not None:
            start[:3] = distance
        if rotation_deg is not None:
            start[3:] = np.radians(rotation_deg)
        samples = body.sample(options.samples, seed=options.seed)
        return cls(body, options, samples, start, T_start, rules, instance=instance)

    @property
    def free(self) -> Mask:
        """Which of the six directions are estimated."""
        return free_mask(self.options)

    @property
    def label(self) -> str:
        """The body in one word."""
        return label_of(self.body.name, self.instance)

    def begin(self) -> Track:
        """The track before the first frame."""
        if self.T_start is None:
            return Track()
        return Track((Branch(self.T_start, 1.0, None, self.start_uncertainty),), known=True)

    def advance(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[Track, Estimate]:
        """Estimate one frame, in a scene that has no other body; see `Scene.advance`."""
        (after,), (estimate,) = self._alone.advance((track,), frame, time_s, views)
        return after, estimate

    @cached_property
    def _alone(self) -> Scene:
        return Scene((self,))

    def predictions(self, track: Track, frame: int, time_s: float | None) -> list[Prediction]:
        """Where the track expects the body in a frame."""
        return predict(track, self.body, frame, time_s, self.rules.motion)

    def data(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> FrameData:
        """A frame, and what is known before it; sensors that saw nothing are left out."""
        seen = [view for view in views if not view.observation.is_empty]
        predictions = self.predictions(track, frame, time_s)
        views = track.delays.applied(seen, time_s, track.seconds_until(time_s))
        data = FrameData(
            views=views,
            body=self.body,
            options=self.options,
            samples=self.samples,
            track=track,
            predictions=predictions,
            T_reference=predictions[0].T_world_object if predictions else self.T_start,
            start_uncertainty=self.start_uncertainty,
            rules=self.rules,
            frame=frame,
            time_s=time_s,
        )
        if not predictions or not is_timed(views):
            return data
        T = predictions[0].T_world_object
        return data.in_motion(data.expected(T).at(T))


def estimate_pose(
    views: Sequence[View],
    model: Body,
    start: Floats | None = None,
    options: EstimatorOptions | None = None,
) -> Estimate:
    """Estimate one pose, as of frame 0, near a start (4, 4) or anywhere.

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

"""A body that is tracked: all that stays the same from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, free_mask
from mixpose.objective import View
from mixpose.records import Floats, label_of
from mixpose.tracking.frame import Frame
from mixpose.tracking.motion import per_kind
from mixpose.tracking.proposers import PROPOSERS, Proposer
from mixpose.tracking.refinements import REFINEMENTS, Refinement
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Branch, Prediction, Track, predict


@dataclass(frozen=True)
class TrackedBody:
    """A body, and how its poses are estimated.

    Attributes
    ----------
    body : Body
    options : EstimatorOptions
    samples : (N, R, 3) float64
        Of the body, for the objectives that integrate by sampling.
    start_uncertainty : (6,) float64
    T_start : (4, 4) float64 or None
    rules : Rules
    proposers : tuple of Proposer
        In the order in which they are tried; the first says where the body is expected.
    refinements : tuple of Refinement
    instance : int or None
        Which of identical bodies, which have the same `Body`; None where there is only one.
    """

    body: Body
    options: EstimatorOptions
    samples: Floats
    start_uncertainty: Floats
    T_start: Floats | None = None
    rules: Rules = Rules()
    proposers: tuple[Proposer, ...] = PROPOSERS
    refinements: tuple[Refinement, ...] = REFINEMENTS
    instance: int | None = None

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
        """Prepare tracking of a body.

        Parameters
        ----------
        body : Body
        options : EstimatorOptions
        T_start : (4, 4) array or None
            Where the body is about the first frame; None: anywhere.
        rotation_deg, distance : float or None
            Half-widths of where to look around the start; None: 5° and a tenth of the radius.
        rules : Rules
        instance : int or None
        """
        motion = rules.motion
        start = per_kind(body, motion.start)
        if distance is not None:
            start[:3] = distance
        if rotation_deg is not None:
            start[3:] = np.radians(rotation_deg)
        samples = body.sample(options.samples, seed=options.seed)
        return cls(body, options, samples, start, T_start, rules, instance=instance)

    @property
    def free(self) -> NDArray[np.bool_]:
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

    def predictions(self, track: Track, frame: int, time_s: float | None) -> list[Prediction]:
        """Where the track expects the body in a frame."""
        return predict(track, self.body, frame, time_s, self.rules.motion)

    def data(self, track: Track, frame: int, time_s: float | None, views: Sequence[View]) -> Frame:
        """A frame, and what is known before it; sensors that saw nothing are left out."""
        views = [view for view in views if not view.observation.is_empty]
        predictions = self.predictions(track, frame, time_s)
        views = track.delays.applied(views, time_s, track.seconds_until(time_s))
        data = Frame(
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
        if predictions and data.is_timed:
            T = predictions[0].T_world_object
            return data.in_motion(data.expected(T).at(T))
        return data

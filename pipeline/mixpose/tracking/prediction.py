"""Predict poses shortly after the last frame, for programs that show or steer something."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.records import Estimate, Floats, replace
from mixpose.rigid import perturb, twist_between
from mixpose.tracking.motion import MotionFilter, MotionRules


@dataclass(frozen=True)
class PosePredictor:
    """The state of predicting the poses of a body.

    Each coordinate is followed by `mixpose.tracking.motion.MotionFilter`, whose filters take the
    velocity, and how steady it is, from the poses and their covariances.
    """

    body: Body
    rules: MotionRules = MotionRules()
    T_world_object: Floats | None = None  # (4, 4), the last pose
    time_s: float = 0.0  # of that pose
    motion_filter: MotionFilter | None = None

    def after(self, estimate: Estimate) -> PosePredictor:
        """Return the state after one more estimate of the body; a lost one changes nothing.

        Raises
        ------
        SessionError
            If the estimate has no time.
        """
        T, time_s, covariance = estimate.T_world_object, estimate.time_s, estimate.covariance
        if time_s is None:
            raise SessionError(
                f"--predict: frame {estimate.frame} has no time; add fps to the [[sensor]], or "
                "times with a row for each frame"
            )
        if T is None or covariance is None:
            return self
        deviation, elapsed = np.sqrt(covariance.diagonal()), time_s - self.time_s
        known = self.motion_filter is not None and 0 < elapsed <= self.rules.longest_s
        if known and self.motion_filter is not None and self.T_world_object is not None:
            moved = twist_between(self.T_world_object, T)
            course = self.motion_filter.followed(moved, deviation, elapsed)
        else:
            course = MotionFilter.begun(deviation, self.body.radius, self.rules)
        return replace(self, T_world_object=T, time_s=time_s, motion_filter=course)

    def ahead(self, estimate: Estimate, seconds: float) -> Estimate:
        """Return the estimate that led to this state, moved some seconds ahead.

        The covariance is that of the estimate plus the effect of the velocity and its changes in
        that time.  Directions that are not estimated stay.  Hypotheses belong to the frame alone
        and are left out; a lost frame stays lost.
        """
        T, covariance, course = estimate.T_world_object, estimate.covariance, self.motion_filter
        later = None if estimate.time_s is None else estimate.time_s + seconds
        # points were measured at the frame's own time
        estimate = replace(estimate, time_s=later, hypotheses=(), points={})
        if T is None or covariance is None or course is None:
            return estimate
        twist, grown = course.ahead(seconds)
        free = covariance.diagonal() > 0
        return replace(
            estimate,
            T_world_object=perturb(T, np.where(free, twist, 0.0)),
            covariance=covariance + np.diag(np.where(free, grown, 0.0)),
        )

"""A pose near a start, with the velocity at which the body is seen there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.fit import Fit
from mixpose.judgement import Judged, nearest_alike
from mixpose.sensors import Motion
from mixpose.tracking.delays import together, widened

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData

Floats: TypeAlias = NDArray[np.float64]

ROUNDS = 5
SETTLED = 1e-3  # of σ_ε: features that a better velocity moves by less stay where they are


def fit_in_motion(
    data: FrameData, T_start: Floats, climb: Callable[[FrameData, Floats], Fit]
) -> Fit:
    """Climb to the most likely pose and velocity near a start.

    Parameters
    ----------
    data : FrameData
        Of sensors that see features at moments of their own.
    T_start : (4, 4) array
    climb : callable
        Takes a frame as of the common time and a pose to the best pose near it.
    """
    motion = data.motion(T_start)
    T = T_start
    for _ in range(ROUNDS):
        seen = data.in_motion(motion)
        fit = climb(seen, T)
        T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
        offsets = seen.offsets(T)
        expected = data.expected(T)
        both = together(offsets, motion.velocity, expected, data.free)
        moved = np.abs(offsets.rows @ both.change * offsets.late)
        motion = Motion(T, motion.velocity + both.change, expected.acceleration)
        if moved.max(initial=0.0) < SETTLED:
            break
    return replace(fit, T_world_object=T, motion=motion)


def with_motion_unknown(judged: Judged, data: FrameData, motion: Motion) -> Judged:
    """A judged pose, as sure as its velocity lets it be."""
    T = judged.T_world_object
    offsets = data.offsets(T, [one for one in judged.associations if judged.sensors[one.name].used])
    expected = data.expected(T)
    wider = widened(judged.covariance, offsets, motion.velocity, expected, data.free)
    return replace(judged, covariance=wider)

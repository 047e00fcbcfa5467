"""A pose near a start, with the velocity at which the body is seen there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.fit import Fit
from mixpose.judgement import Judged, nearest_alike
from mixpose.rigid import perturb
from mixpose.sensors import Motion
from mixpose.tracking.delays import together, widened

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData

Floats: TypeAlias = NDArray[np.float64]

ROUNDS = 6
LINEAR = 0.1  # of σ_ε: where a better velocity moves features by less, steps do, without a climb
SETTLED = 2e-3  # of σ_ε: where it moves them by less, they stay where they are


def fit_in_motion(
    data: FrameData, T_start: Floats, climb: Callable[[FrameData, Floats, float], Fit]
) -> Fit:
    """Climb to the most likely pose and velocity near a start.

    The pose is climbed to as if the velocity were known, then steps of both are taken in turns.

    Parameters
    ----------
    data : FrameData
        Of sensors that see features at moments of their own.
    T_start : (4, 4) array
    climb : callable
        Takes a frame as of the common time, a pose, and how far features may be off, in σ_ε, to
        the best pose near it.
    """
    motion = data.motion(T_start, is_there=False)
    T, expected, moved = T_start, data.expected(T_start), np.inf
    for _ in range(ROUNDS):
        seen = data.in_motion(motion)
        if moved > LINEAR:
            fit = climb(seen, T, seen.unsure(T, expected))
            T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
        expected = data.expected(T)
        offsets = seen.offsets(T, expected)
        both = together(offsets, motion.velocity, expected, data.free)
        moved = float(np.abs(offsets.rows @ both.change * offsets.late).max(initial=0.0))
        T = np.asarray(perturb(T, offsets.followed(both.change, data.free)))
        motion = Motion(T, motion.velocity + both.change, expected.acceleration)
        if moved < SETTLED:
            break
    return replace(fit, T_world_object=T, motion=motion)


def with_motion_unknown(judged: Judged, data: FrameData, motion: Motion) -> Judged:
    """A judged pose, as sure as its velocity lets it be."""
    T = judged.T_world_object
    expected = data.expected(T)
    used = [one for one in judged.associations if judged.sensors[one.name].used]
    offsets = data.offsets(T, expected, used)
    wider = widened(judged.covariance, offsets, motion.velocity, expected, data.free)
    return replace(judged, covariance=wider)

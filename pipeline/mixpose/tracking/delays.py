"""Sensors that are a little out of step, brought into step by how the body moves.

A sensor that takes its frame a moment later sees the body where it has moved to meanwhile.  To the
body at the common time that is the same as a sensor that has moved the other way.
"""

from __future__ import annotations

from dataclasses import replace

from mixpose.objective import View
from mixpose.rigid import inverse, perturb
from mixpose.tracking.motion import MotionRules
from mixpose.tracking.track import Track, elapsed_since


def in_step(
    views: list[View],
    track: Track,
    frame: int,
    time_s: float | None,
    rules: MotionRules = MotionRules(),
) -> list[View]:
    """Views with sensors moved by what the body moves in their delays.

    Parameters
    ----------
    views : list of View
    track : Track
        Before the frame; without a velocity in seconds the views stay as they are.
    frame : int
    time_s : float or None
        Common time, from which delays count.
    rules : MotionRules
    """
    if time_s is None or track.time_s is None or not any(view.delay for view in views):
        return views
    if not track.branches or track.misses > rules.coasting:
        return views
    velocity = track.branches[0].steady
    if velocity is None:
        return views
    elapsed = elapsed_since(track, frame, time_s)
    if any(abs(view.delay) > elapsed for view in views):  # their clocks are not the same
        return views
    T_predicted = perturb(track.branches[0].T_world_object, velocity * elapsed)
    stepped = []
    for view in views:
        T_later = perturb(T_predicted, velocity * view.delay)
        motion = T_later @ inverse(T_predicted)
        stepped.append(replace(view, sensor=view.sensor.moved(motion)))
    return stepped

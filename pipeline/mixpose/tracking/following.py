"""Follow the poses of a frame: the branches of the track for the next one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mixpose.judgement import nearest_alike
from mixpose.records import Floats, replace
from mixpose.rigid import inverse, perturb, twist_between
from mixpose.tracking.frame import Frame
from mixpose.tracking.motion import MotionFilter, RandomWalk, per_kind
from mixpose.tracking.track import Branch, Track


def follow(
    frame: Frame, poses: Sequence[tuple[Branch, Sequence[Floats] | None]], **known: Any
) -> Track:
    """Return the track after a frame with poses, the best first, and further fields `known`.

    With each pose come its look-alikes, motions (4, 4) of the body, one of which may have been
    followed; None where the pose does not go on from the frame before.
    """
    track, body = frame.track, frame.body
    elapsed, walk = track.elapsed(frame.frame, frame.time_s), track.walk
    continued = [_continued(frame, pose, alike) for pose, alike in poses]
    branch, moved = continued[0]
    if branch.spread is not None and moved is not None:
        walk = walk or RandomWalk.unknown(body, elapsed, frame.rules.motion)
        walk = walk.joined(moved, body.radius, elapsed)
    return replace(
        track,
        branches=tuple([branch for branch, _ in continued]),
        frame=frame.frame,
        time_s=frame.time_s,
        misses=0,
        walk=walk,
        search=Track.search,
        **known,
    )


def _continued(
    frame: Frame, pose: Branch, alike: Sequence[Floats] | None
) -> tuple[Branch, Floats | None]:
    """Return the branch of a pose for the next frame, and the twist (6,) to it, if it goes on."""
    track, body, rules = frame.track, frame.body, frame.rules.motion
    elapsed, is_timed = track.elapsed(frame.frame, frame.time_s), track.is_timed_as(frame.time_s)
    steady, T, moved = per_kind(body.radius, rules.steady), pose.T_world_object, None
    left_open = np.minimum(np.sqrt(pose.left_open.diagonal().clip(0.0)), frame.flat_prior[1])
    velocity, motion_filter, uncertainty = None, None, rules.unsteady * steady
    parent = track.nearest(T, body) if track.frame is not None and elapsed > 0 else None
    if parent is not None:  # of poses that look the same, the nearest to the parent
        T = nearest_alike(T, body, parent.T_world_object)
    if parent is not None and alike is not None:
        ahead = zip(track.branches, frame.predictions, strict=True)
        expected = next(after for before, after in ahead if before is parent)
        moved, is_other = _twist_since(parent, expected, T, frame, alike)
        parent = replace(parent, velocity=None, motion_filter=None) if is_other else parent
        if pose.spread is None and not is_other:
            T, left_open = _fused(expected, T, pose.left_open)
            moved = twist_between(parent.T_world_object, T)
        if pose.spread is None and track.misses <= rules.coasting and is_timed:
            velocity = moved / elapsed
            last = parent.velocity
            change = moved / 2 if last is None else moved - last * elapsed
            # per frame, where the change was seen over several
            change = np.abs(change / (1 + track.misses)).reshape(2, 3)
            uncertainty = np.maximum(change.max(axis=1).repeat(3), steady)
        if frame.is_timed and parent.motion_filter and elapsed <= rules.longest_s:
            motion_filter = parent.motion_filter.followed(moved, pose.deviation, elapsed)
    if frame.is_timed:
        motion_filter = motion_filter or MotionFilter.begun(pose.deviation, body.radius, rules)
    branch = replace(
        pose,
        T_world_object=T,
        velocity=velocity,
        # a prediction is no surer than the pose that it starts from
        uncertainty=np.maximum(uncertainty, left_open),
        motion_filter=motion_filter,
    )
    return branch, moved


def _twist_since(
    parent: Branch, expected: Branch, T_world_object: Floats, frame: Frame, alike: Sequence[Floats]
) -> tuple[Floats, bool]:
    """Return the twist (6,) to a pose from the one before, and whether that was a look-alike.

    The look-alike is chosen where the prediction makes it likelier, with the chance that it was
    followed: `surprise`, or after an ok frame that of a wrong ok.
    """
    T_before, chosen = parent.T_world_object, 0
    if alike:
        like = np.concatenate([T_world_object[None], T_world_object @ np.array(alike)])
        logs = expected.log_density(like, frame.free, frame.rules.motion)
        is_unsure = frame.track.doubted or not frame.track.ok_count
        rules = frame.rules
        logs[1:] += math.log(rules.motion.surprise) if is_unsure else rules.acceptance.log_doubt
        if chosen := int(logs.argmax()):
            T_before = T_before @ inverse(alike[chosen - 1])
    return twist_between(T_before, T_world_object), chosen > 0


def _fused(expected: Branch, T_world_object: Floats, left_open: Floats) -> tuple[Floats, Floats]:
    """Return the pose (4, 4) and deviations (6,) by a prediction and a pose of a covariance (6, 6).

    A Kalman update.  Directions that a frame shows well are as they are seen; a turn that it leaves
    open is that of the prediction.
    """
    scale = np.maximum(expected.uncertainty, 1e-300)
    variances, axes = np.linalg.eigh(left_open / scale / scale[:, None])
    gains = 1 / (1 + variances.clip(0.0))  # in units of the prediction's uncertainty
    off = twist_between(expected.T_world_object, T_world_object) / scale
    twist = scale * (axes @ (gains * (off @ axes)))
    return perturb(expected.T_world_object, twist), scale * np.sqrt(axes**2 @ (1 - gains))

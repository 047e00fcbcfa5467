"""Markers of a body and its poses adjusted together, by what calibrates sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body import like_features, symmetries
from mixpose.calibration import CalibrationRules, Rig, SeenFrame
from mixpose.calibration.adjust import Adjusted, adjust
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.gauge import gauge_rows
from mixpose.calibration.recorded import informative
from mixpose.calibration.rig import State, blocks_of
from mixpose.learning.points import Cloud, are_points
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import FEWEST, Found, Places, body_of, only_once, usual_reach
from mixpose.records import Floats, Indices
from mixpose.rigid import inverse, transform
from mixpose.sensors import CalibrationError

_MET = 0.2  # weight of a pair that counts as seen: within 2.5 deviations


@dataclass(frozen=True, eq=False)
class Eyes:
    """The sensors of a recording."""

    rig: Rig  # its body is none of those that are learnt
    sigmas: Floats  # (L,): σ_ε of each
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)  # of what is told


@dataclass(frozen=True, eq=False)
class Learnt:
    """A body as its recording shows it."""

    names: tuple[str, ...]  # of the markers
    points: Floats  # (N, 3)
    covariances: Floats  # (N, 3, 3): in the frame in which markers are where they are on average
    frames: Indices  # (N,): frames in which two cameras or more saw it, or a cloud
    poses: Floats  # (K, 4, 4): T_world_object in the frames that were adjusted
    numbers: Indices  # (K,): of these frames; of congruent bodies each has its own pose
    count: int  # congruent bodies that were seen at a time
    residual: float  # deviation of detections, as a share of σ_ε
    # deviation of markers about their places, along an axis, beyond errors of detections; or 0
    spread: float
    met: Mapping[str, float] = field(default_factory=dict)  # by sensor, markers in a frame

    @property
    def deviations(self) -> Floats:
        """Standard deviations (N, 3) of the coordinates.

        Three markers are in one plane whatever they are, which is exact.
        """
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def within(self, T_new_old: Floats, order: Indices | None = None) -> Learnt:
        """The body in another frame, its markers in another order."""
        R = T_new_old[:3, :3]
        k = np.arange(len(self.points)) if order is None else order
        return replace(
            self,
            names=tuple(self.names[n] for n in k.tolist()),
            points=transform(T_new_old, self.points[k]),
            covariances=R @ self.covariances[k] @ R.T,
            frames=self.frames[k],
            poses=self.poses @ inverse(T_new_old),
        )


def adjusted(bodies: Sequence[Found], clouds: Sequence[Cloud], eyes: Eyes) -> list[Learnt]:
    """Adjust bodies one by one, each by the detections that belong to no other.

    Markers of which too few frames are left are dropped; bodies with fewer than three, too.  What
    may map onto itself is as `as_symmetric` has it.
    """
    learnt = []
    for body in bodies:
        frames, poses = _frames_of(body, bodies, clouds, eyes)
        points = body.shape.points
        while len(points) >= FEWEST:
            found = _adjusted(points, frames, poses, eyes)
            seen = _seen(found, len(points), len(frames), eyes)
            kept = seen >= max(RULES.least_frames, RULES.least_share * len(frames))
            reach = usual_reach(body.places, clouds)
            near = RULES.alike * RULES.gate * reach
            kept &= only_once(found.state.rig.points, seen, np.full(len(points), near))
            if kept.all():
                rig, blocks = found.state.rig, found.covariance.reshape(len(points), 3, -1, 3)
                one = Learnt(
                    names=rig.body.labels,
                    points=rig.points,
                    covariances=np.array([blocks[k, :, k] for k in range(len(points))]),
                    frames=seen,
                    poses=found.state.poses,
                    numbers=np.array([frame.number for frame in frames]),
                    count=body.count,
                    residual=float(np.sqrt(np.mean((found.noise / eyes.sigmas) ** 2))),
                    spread=_spread(body, clouds),
                    met={
                        name: len(pairs) / len(frames)
                        for name, pairs in zip(rig.names, _pairs_met(found), strict=True)
                    },
                )
                learnt.append(as_symmetric(one, reach))
                break
            points = points[kept]
    return learnt


def as_symmetric(learnt: Learnt, reach: float) -> Learnt:
    """The body as symmetric as it may be, where a frame that errs by `reach` cannot tell its turns.

    In each frame that turn was taken which noise suits best, so that noise is learnt as the body's
    own shape.  How far the markers were off their mean over all turns is in their covariances, as
    nobody knows whether that is their own.
    """
    points = learnt.points
    turns = symmetries(points, 2 * reach)
    if len(turns) == 1:
        return learnt
    images = transform(turns, points)
    nearest = np.array([cKDTree(points).query(each)[1] for each in images])
    # of each turn, the image that lies at each marker
    mean = images[np.arange(len(turns))[:, None], nearest.argsort(axis=1)].mean(axis=0)
    off = np.linalg.norm(points - mean, axis=1)
    if off.max() > reach:
        return learnt
    own = np.eye(3) * float(np.mean(off**2)) / 3
    return replace(learnt, points=mean, covariances=learnt.covariances + own)


def _frames_of(
    body: Found, bodies: Sequence[Found], clouds: Sequence[Cloud], eyes: Eyes
) -> tuple[tuple[SeenFrame, ...], Floats]:
    """What sensors saw of a body in the frames that tell most of it; and its poses there."""
    taken: dict[int, list[tuple[object, Indices]]] = {}
    for each in bodies:
        for k, one in each.places:
            own = clouds[k].detections[one.there]
            taken.setdefault(k, []).append((one, own))
    frames, poses = list[SeenFrame](), dict[int, Floats]()
    for k, one in _told_apart(body, clouds):
        others = [own for owner, own in taken[k] if owner is not one]
        frame = _left(clouds[k].seen, others, timed=body.count == 1)
        frames.append(frame)
        poses[id(frame)] = one.T_world_shape
    chosen = informative(frames, len(eyes.sigmas), RULES.adjusted, runs=eyes.rig.is_late)
    return chosen, np.array([poses[id(frame)] for frame in chosen])


def _told_apart(body: Found, clouds: Sequence[Cloud]) -> Places:
    """Placements whose points lie like no others of the shape; all, where these are too few."""
    model = body_of("", body.shape.points)  # of the others nobody knows how it is turned
    off = RULES.gate * usual_reach(body.places, clouds)
    told = [
        (k, one)
        for k, one in body.places
        if not like_features(model, frozenset(one.own.tolist()), model, off)
    ]
    return told if len(told) >= RULES.least_frames else body.places


def _left(seen: SeenFrame, others: Sequence[Indices], *, timed: bool) -> SeenFrame:
    """A frame without the detections (n, L) of other bodies, and in time where these are told."""
    # of bodies alike no one knows which one went where, so that their motion is not known
    points = {}
    for sensor, pixels in seen.points.items():
        left = np.ones(len(pixels), dtype=np.bool_)
        for own in others:
            left[own[own[:, sensor] >= 0, sensor]] = False
        points[sensor] = pixels[left]
    return SeenFrame(seen.number, seen.time_s if timed else None, points, seen.times)


def _adjusted(points: Floats, frames: tuple[SeenFrame, ...], poses: Floats, eyes: Eyes) -> Adjusted:
    rig = replace(eyes.rig, points=points, body=body_of("", points))
    blocks = blocks_of(rig, {}, body=True, length=1.0, interval=1.0)
    free = np.ones(6, dtype=np.bool_)
    state = State(rig, poses)
    gauge, _ = gauge_rows(state, blocks, free)
    bundle = Bundle(
        frames, blocks, free, lambda _: gauge, eyes.sigmas, CalibrationRules(), eyes.errors
    )
    return adjust(bundle, state)


def _pairs_met(found: Adjusted) -> Iterator[Indices]:
    """Frame and marker (n, 2) of what each sensor met."""
    for rows, weight in found.weighted:
        good = rows.pairs.nearest & (weight > _MET)
        yield np.column_stack([rows.pairs.frame, rows.pairs.feature])[good]


def _seen(found: Adjusted, markers: int, frames: int, eyes: Eyes) -> Indices:
    """Frames (N,) in which two cameras or more met a marker, or a cloud."""
    met = np.zeros((frames, markers), dtype=np.intp)
    counts = 1 + are_points(eyes.rig.sensors)
    for pairs, count in zip(_pairs_met(found), counts, strict=True):
        np.add.at(met, tuple(pairs.T), count)
    return np.asarray((met >= 2).sum(axis=0))


def _spread(body: Found, clouds: Sequence[Cloud]) -> float:
    """How far markers of a loose body are off along an axis, but for errors of triangulation."""
    if body.loose <= 1:
        return 0.0
    squared, expected, count = 0.0, 0.0, 0
    for k, one in body.places:
        shown = transform(one.T_world_shape, body.shape.points[one.own])
        squared += float(((clouds[k].points[one.there] - shown) ** 2).sum())
        expected += float((clouds[k].reach[one.there] ** 2).sum())
        count += 3 * one.count - 6
    return float(np.sqrt(max(squared - expected, 0.0) / max(count, 1)))

"""Adjust the markers of a body and its poses together, as the calibration adjusts sensors."""

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
from mixpose.learning.shapes import FEWEST, PlacedBody, Placements, are_unique, body_of, usual_sigma
from mixpose.records import Floats, Indices
from mixpose.rigid import inverse, transform
from mixpose.sensors import CalibrationError

_MET = 0.2  # weight from which a pair counts as met: within 2.5 deviations


@dataclass(frozen=True, eq=False)
class SensorSet:
    """The sensors of a recording."""

    rig: Rig  # its body is not used
    sigmas: Floats  # (L,): σ_ε
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)  # where stated


@dataclass(frozen=True, eq=False)
class LearntBody:
    """A body as its recording shows it."""

    names: tuple[str, ...]  # of the markers
    points: Floats  # (N, 3)
    covariances: Floats  # (N, 3, 3): in the frame that is fixed by the markers' mean
    frames: Indices  # (N,): number of frames in which two cameras or more, or a cloud, saw a marker
    poses: Floats  # (K, 4, 4): T_world_object in the frames that were adjusted
    numbers: Indices  # (K,): of these frames, which repeat if congruent bodies have a pose each
    count: int  # congruent bodies that were seen at the same time
    residual: float  # deviation of detections, as a share of σ_ε
    # standard deviation of markers from their places, per axis, beyond triangulation errors; or 0
    spread: float
    met: Mapping[str, float] = field(default_factory=dict)  # by sensor, markers per frame

    @property
    def deviations(self) -> Floats:
        """Standard deviations (N, 3) of the coordinates.

        Three markers always lie in one plane, so that coordinates across it are exact.
        """
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def within(self, T_new_old: Floats, order: Indices | None = None) -> LearntBody:
        """Return the body in another frame, with its markers in another order."""
        R = T_new_old[:3, :3]
        rows = np.arange(len(self.points)) if order is None else order
        return replace(
            self,
            names=tuple(self.names[n] for n in rows.tolist()),
            points=transform(T_new_old, self.points[rows]),
            covariances=R @ self.covariances[rows] @ R.T,
            frames=self.frames[rows],
            poses=self.poses @ inverse(T_new_old),
        )


def adjust_bodies(
    bodies: Sequence[PlacedBody], clouds: Sequence[Cloud], sensor_set: SensorSet
) -> list[LearntBody]:
    """Adjust bodies one by one, each to the detections that belong to no other.

    Markers with too few frames are dropped, and so are bodies with fewer than three markers.
    Bodies that may be symmetric are made so by `as_symmetric`.
    """
    learnt_bodies = []
    for body in bodies:
        frames, poses = _frames_of(body, bodies, clouds, sensor_set)
        points = body.shape.points
        while len(points) >= FEWEST:
            adjusted = _adjust_together(points, frames, poses, sensor_set)
            frames_seen = _frames_seen(adjusted, len(points), len(frames), sensor_set)
            is_kept = frames_seen >= max(RULES.least_frames, RULES.least_share * len(frames))
            sigma = usual_sigma(body.placements, clouds)
            near = np.full(len(points), RULES.alike * RULES.gate * sigma)
            is_kept &= are_unique(adjusted.state.rig.points, frames_seen, near)
            if is_kept.all():
                rig, blocks = adjusted.state.rig, adjusted.covariance.reshape(len(points), 3, -1, 3)
                met = zip(rig.names, _pairs_met(adjusted), strict=True)
                learnt_body = LearntBody(
                    names=rig.body.labels,
                    points=rig.points,
                    covariances=np.array([blocks[k, :, k] for k in range(len(points))]),
                    frames=frames_seen,
                    poses=adjusted.state.poses,
                    numbers=np.array([frame.number for frame in frames]),
                    count=body.count,
                    residual=float(np.sqrt(np.mean((adjusted.noise / sensor_set.sigmas) ** 2))),
                    spread=_spread(body, clouds),
                    met={name: len(pairs) / len(frames) for name, pairs in met},
                )
                learnt_bodies.append(as_symmetric(learnt_body, sigma))
                break
            points = points[is_kept]
    return learnt_bodies


def as_symmetric(learnt: LearntBody, tolerance: float) -> LearntBody:
    """Return the body made symmetric, if frames that err by `tolerance` cannot show its turns.

    In each frame the turn that suits the noise best was taken, so that the learnt shape contains
    noise.  Offsets of markers from their mean over all turns are added to their covariances, as
    they may belong to the body.
    """
    points = learnt.points
    turns = symmetries(points, 2 * tolerance)
    if len(turns) == 1:
        return learnt
    images = transform(turns, points)
    nearest = np.array([cKDTree(points).query(image)[1] for image in images])
    # mean over all turns of the image at each marker
    mean = images[np.arange(len(turns))[:, None], nearest.argsort(axis=1)].mean(axis=0)
    offsets = np.linalg.norm(points - mean, axis=1)
    if offsets.max() > tolerance:
        return learnt
    added = np.eye(3) * float(np.mean(offsets**2)) / 3
    return replace(learnt, points=mean, covariances=learnt.covariances + added)


def _frames_of(
    body: PlacedBody, bodies: Sequence[PlacedBody], clouds: Sequence[Cloud], sensor_set: SensorSet
) -> tuple[tuple[SeenFrame, ...], Floats]:
    """Return the most informative frames of a body, without detections of others, and its poses."""
    claimed: dict[int, list[tuple[object, Indices]]] = {}
    for other in bodies:
        for k, placement in other.placements:
            detections = clouds[k].detections[placement.cloud_rows]
            claimed.setdefault(k, []).append((placement, detections))
    frames, poses = list[SeenFrame](), dict[int, Floats]()
    for k, placement in _unambiguous(body, clouds):
        others = [detections for owner, detections in claimed[k] if owner is not placement]
        frame = _unclaimed(clouds[k].frame, others, is_timed=body.count == 1)
        frames.append(frame)
        poses[id(frame)] = placement.T_world_shape
    best = informative(frames, len(sensor_set.sigmas), RULES.adjusted, runs=sensor_set.rig.is_late)
    return best, np.array([poses[id(frame)] for frame in best])


def _unambiguous(body: PlacedBody, clouds: Sequence[Cloud]) -> Placements:
    """Return placements whose points lie like no others of the shape, or all if these are few."""
    model = body_of("", body.shape.points)  # points that lie like others do not fix its turn
    tolerance = RULES.gate * usual_sigma(body.placements, clouds)
    unambiguous = [
        (k, placement)
        for k, placement in body.placements
        if not like_features(model, frozenset(placement.shape_rows.tolist()), model, tolerance)
    ]
    return unambiguous if len(unambiguous) >= RULES.least_frames else body.placements


def _unclaimed(frame: SeenFrame, others: Sequence[Indices], *, is_timed: bool) -> SeenFrame:
    """Return a frame without the detections (n, L) of others, and without its time if not timed."""
    # bodies alike are not followed from frame to frame, so that their motion is unknown
    points = {}
    for sensor, pixels in frame.points.items():
        is_unclaimed = np.ones(len(pixels), dtype=np.bool_)
        for detections in others:
            is_unclaimed[detections[detections[:, sensor] >= 0, sensor]] = False
        points[sensor] = pixels[is_unclaimed]
    return SeenFrame(frame.number, frame.time_s if is_timed else None, points, frame.times)


def _adjust_together(
    points: Floats, frames: tuple[SeenFrame, ...], poses: Floats, sensor_set: SensorSet
) -> Adjusted:
    rig = replace(sensor_set.rig, points=points, body=body_of("", points))
    blocks = blocks_of(rig, {}, body=True, length=1.0, interval=1.0)
    free = np.ones(6, dtype=np.bool_)
    state = State(rig, poses)
    gauge, _ = gauge_rows(state, blocks, free)
    sigmas, errors = sensor_set.sigmas, sensor_set.errors
    bundle = Bundle(frames, blocks, free, lambda _: gauge, sigmas, CalibrationRules(), errors)
    return adjust(bundle, state)


def _pairs_met(adjusted: Adjusted) -> Iterator[Indices]:
    """Yield for each sensor the frame and marker (n, 2) of the pairs met."""
    for rows, weight in adjusted.weighted:
        is_met = rows.pairs.nearest & (weight > _MET)
        yield np.column_stack([rows.pairs.frame, rows.pairs.feature])[is_met]


def _frames_seen(adjusted: Adjusted, markers: int, frames: int, sensor_set: SensorSet) -> Indices:
    """Count the frames (N,) in which two cameras or more, or a cloud, met a marker."""
    met = np.zeros((frames, markers), dtype=np.intp)
    counts = 1 + are_points(sensor_set.rig.sensors)
    for pairs, count in zip(_pairs_met(adjusted), counts, strict=True):
        np.add.at(met, tuple(pairs.T), count)
    return np.asarray((met >= 2).sum(axis=0))


def _spread(body: PlacedBody, clouds: Sequence[Cloud]) -> float:
    """Estimate how far markers move on a loose body, per axis, beyond errors of triangulation."""
    if body.looseness <= 1:
        return 0.0
    squared, expected, count = 0.0, 0.0, 0
    for k, placement in body.placements:
        rows, points = placement.cloud_rows, body.shape.points[placement.shape_rows]
        offsets = clouds[k].points[rows] - transform(placement.T_world_shape, points)
        squared += float((offsets**2).sum())
        expected += float((clouds[k].sigma[rows] ** 2).sum())
        count += 3 * placement.count - 6
    return float(np.sqrt(max(squared - expected, 0.0) / max(count, 1)))

"""What sensors would detect of a body: shuffled, without labels, some hidden, some false."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View, project_body
from mixpose.objective.matched import STEPS_PER_SIGMA
from mixpose.objective.paper import SampledTerm
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import from_rotation_vector, perturb, transform, twist_between
from mixpose.sensors import Sensor
from mixpose.tracking import Track, Tracker

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
TRUTH = from_rotation_vector([0.3, 0.2, -0.5], [45.0, 30.0, 5.0])
ALL_FREE = np.ones(6, dtype=np.bool_)
EIGHT = Body(
    "eight",
    tuple(PointFeature(point) for point in np.random.default_rng(0).uniform(-80, 80, (8, 3))),
)


def view_of(name: str, sensor: Sensor, points: Floats, sigma: float = 1.5) -> View:
    """Detections (M, m) of equal weight."""
    return View(name, sensor, Observation(PointPattern(points, np.ones(len(points))), sigma))


def drawn_everywhere(views: Sequence[View], sigma: float) -> list[SampledTerm]:
    """Densities wherever sensors see, with features of a standard deviation."""
    boxes = [(view.sensor.lower, view.sensor.upper) for view in views]
    return [
        SampledTerm(view.sensor, view.observation.density(sigma, box, gradient=True))
        for view, box in zip(views, boxes, strict=True)
    ]


def detect(
    sensors: Sequence[Sensor],
    body: Body,
    T: Floats,
    *,
    noise: float = 0.0,
    hidden: int = 0,
    false: int = 0,
    sigma: float = 1.5,
    seed: int = 0,
) -> list[View]:
    """Shuffled, unlabelled detections of a body, some hidden, some false."""
    rng = np.random.default_rng(seed)
    views = []
    for k, sensor in enumerate(sensors):
        y, visible = sensor.project(transform(T, body.means))
        y = y[visible] + rng.normal(0, noise, y[visible].shape) if noise else y[visible]
        y = y[rng.permutation(len(y))[hidden:]]
        clutter = rng.uniform(y.min(axis=0) - 100, y.max(axis=0) + 100, (false, y.shape[1]))
        views.append(view_of(str(k), sensor, np.concatenate([y, clutter]), sigma))
    return views


def followed(frames: Iterable[tuple[Body, Floats, list[View]]]) -> list[tuple[Estimate, float]]:
    """Estimates of frames of one body at true poses, ten a second, and their squared errors.

    By their covariances, without a start.
    """
    told, tracker, track = list[tuple[Estimate, float]](), None, Track()
    for k, (body, T, views) in enumerate(frames):
        tracker = tracker or Tracker.create(body, EstimatorOptions())
        track, estimate = tracker.advance(track if k else tracker.begin(), k, 0.1 * k, views)
        assert estimate.T_world_object is not None
        assert estimate.covariance is not None
        away = twist_between(estimate.T_world_object, T)
        told.append((estimate, float(away @ np.linalg.solve(estimate.covariance, away))))
    return told


def random_start(seed: int, length: float = 6.0, angle_deg: float = 3.0) -> Floats:
    """A pose near `TRUTH`, uniform within a length and an angle along and about each axis."""
    rng = np.random.default_rng(seed)
    return perturb(TRUTH, rng.uniform(-1, 1, 6) * np.repeat([length, np.radians(angle_deg)], 3))


def interpolation_bound(views: Sequence[View], body: Body, T: Floats, free: Mask) -> Floats:
    """By how much the look-up of exact detections may move each number of a pose (6,).

    Features apart: as the look-up is, the zero of a gradient moves by up to √3/72 n⁻³ standard
    deviations of C along each axis (`test_density_atlas.py`), with n cells per standard deviation.
    Least squares put the pose where such errors of all coordinates, whatever their signs, move it
    by the sums of the magnitudes of the rows of the inverse.
    """
    return _moved_by_look_up(views, body, T, free, np.eye(6))


def interpolation_bound_of_features(views: Sequence[View], body: Body, T: Floats) -> Floats:
    """The same of each feature in the world (n, 3)."""
    arms = body.means @ T[:3, :3].T
    by_turn = np.cross(np.eye(3)[None], arms[:, None], axisb=2)
    by_pose = np.concatenate(
        [np.tile(np.eye(3), (len(arms), 1, 1)), by_turn.swapaxes(1, 2)], axis=2
    )
    return _moved_by_look_up(views, body, T, ALL_FREE, by_pose.reshape(-1, 6)).reshape(-1, 3)


def _moved_by_look_up(
    views: Sequence[View], body: Body, T: Floats, free: Mask, of_pose: Floats
) -> Floats:
    at = project_body(tuple(view.sensor for view in views), body).project(T[None])
    rows = [
        at.J[k, 0, at.seen[k, 0], : view.sensor.dimension].reshape(-1, 6) / view.observation.sigma
        for k, view in enumerate(views)
    ]
    error = np.sqrt(3) / 72 / STEPS_PER_SIGMA**3 * np.sqrt(2)  # in σ_ε
    inverse = np.linalg.pinv(np.concatenate(rows)[:, free])
    return np.asarray(np.abs(of_pose[:, free] @ inverse).sum(axis=1) * error)


def first_frame(tracker: Tracker, views: list[View]) -> Estimate:
    """Of a track that knows nothing yet."""
    return tracker.advance(tracker.begin(), 0, None, views)[1]


def without(tracker: Tracker, *names: str) -> Tracker:
    """A tracker that does not have some of the proposers or refinements."""
    proposers, refinements = tracker.proposers, tracker.refinements
    assert {*names} <= {one.__name__ for one in (*proposers, *refinements)}
    return replace(
        tracker,
        proposers=tuple(one for one in proposers if one.__name__ not in names),
        refinements=tuple(one for one in refinements if one.__name__ not in names),
    )

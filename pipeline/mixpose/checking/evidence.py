"""Score how well a body and sensors, of the session or changed, explain frames.

Also match features to detections, to fit values to several frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.checking.lookalikes import NOISE_OF_SIGMA
from mixpose.checking.placement import Camera
from mixpose.checking.rules import DiagnosisRules
from mixpose.fit import free_mask
from mixpose.judgement import ScoredPose
from mixpose.matching import Matches
from mixpose.objective import View
from mixpose.records import Estimate, Floats, Indices, Mask, PointPattern
from mixpose.rigid import TWIST_NAMES
from mixpose.runner import begin
from mixpose.sensors.moving import read_times
from mixpose.session import Session
from mixpose.threads import one_blas_thread
from mixpose.tracking.frame import Start
from mixpose.tracking.likelihood import likelihood_of

Views: TypeAlias = Sequence[View]
Frames: TypeAlias = Sequence[tuple[int, Views]]
Pairs: TypeAlias = tuple[Indices, Floats, Floats]  # features, observed, noise of `CameraMatches`
Posed: TypeAlias = tuple[Sequence[View], ScoredPose]

_TIME_S = 0.0  # of a single frame: any will do, but late sensors need one
_FEW = 3  # features in view, from which a sensor constrains the pose
_FEWEST = 0.1  # of the body's features: frames with fewer detections determine no pose
_MISSED = 0.3  # of the expected features: a camera that meets less mostly misses the body
_REACH = 3.0  # times sigma, from a displaced feature to its detection
_NEARBY = 10.0  # times sigma, from a missed feature to a detection that may be its own
_FARTHEST = 0.15  # of the image, the longest displacement
_DISPLACEMENTS = 2000  # tried at most


@dataclass(frozen=True)
class Explained:
    """The best pose of each frame; None if nothing was seen or no pose was found."""

    poses: tuple[ScoredPose | None, ...]

    @property
    def evidence(self) -> float:
        """Sum of log odds against clutter; a frame that clutter explains better adds 0."""
        return sum(evidence_of(pose) for pose in self.poses)

    def explained_count(self, rules: DiagnosisRules) -> int:
        """Count the frames that are explained by all of their sensors."""
        return sum(pose is not None and is_explained(pose, rules) for pose in self.poses)

    def met_count(self, feature: int | None = None) -> float:
        """Count the features that sensors meet, or the sensors that meet one feature."""
        return sum(
            float(pose.matches.shares[:, _columns(feature)].sum())
            for pose in self.poses
            if pose is not None
        )

    def rms(self, feature: int | None = None) -> float:
        """Return the median over frames of the RMS offset of all features, or of one, in sigma."""
        offsets = [rms_of(pose, feature) for pose in self.poses if pose is not None]
        return float(np.median([rms for rms in offsets if np.isfinite(rms)] or [0.0]))


def evidence_of(pose: ScoredPose | None) -> float:
    """Return the log odds of a pose against clutter, at least 0."""
    return 0.0 if pose is None else max(pose.log_evidence, 0.0)


def rms_of(pose: ScoredPose, feature: int | None = None) -> float:
    """Return the RMS offset of all features, or of one, at a pose, in sigma; NaN if none is met."""
    matches, noise = pose.matches, NOISE_OF_SIGMA**2
    # a spot that is cut counts less, by its extra variance
    shares = (matches.shares * (noise / (noise + matches.extra)))[:, _columns(feature)]
    total = float(shares.sum())
    squares = float((shares * matches.squared[:, _columns(feature)]).sum())
    return float(np.sqrt(squares / total)) if total > 0 else np.nan


def _columns(feature: int | None) -> slice:
    return slice(feature, None if feature is None else feature + 1)


def is_explained(pose: ScoredPose, rules: DiagnosisRules) -> bool:
    """Test whether a pose is sure and every sensor meets enough of the features it could."""
    matches = pose.matches
    # if a sensor with detections has the body out of view, they are clutter or the view is wrong;
    # a feature or two there could be met under any change
    in_view = np.where(matches.expected >= _FEW, matches.expected, matches.expected.max())
    could = np.minimum(matches.count, in_view)
    is_sure = pose.log_evidence > rules.sure and not pose.left_out
    return bool(is_sure and (matches.met >= rules.met * could).all())


def is_well_explained(pose: ScoredPose | None, rules: DiagnosisRules) -> bool:
    """Test whether a pose is explained with offsets as small as those of good recordings."""
    return pose is not None and is_explained(pose, rules) and rms_of(pose) < rules.noise


def without_start(session: Session) -> Session:
    """Return the session without its start, which may be wrong, if no start is needed."""
    return replace(session, start=None) if free_mask(session.estimator).all() else session


def estimate_of(session: Session, number: int, views: Views) -> Estimate:
    """Return the estimate of a run whose first frame this is."""
    tracker, track = begin(session)
    return tracker.advance(track, number, _TIME_S, views)[1]


def are_sufficient(views: Views, features: int) -> bool:
    """Test whether detections can determine a pose; grids of values always may.

    They need more coordinates than a pose has, as any pose meets six, and one in ten of the body's
    features: a feature met gains up to ten nats against clutter, one missed costs two.
    """
    patterns = [view.observation.pattern for view in views]
    points = [pattern.points for pattern in patterns if isinstance(pattern, PointPattern)]
    are_few = max(map(len, points), default=0) < _FEWEST * features
    are_enough = sum(detections.size for detections in points) > len(TWIST_NAMES) and not are_few
    return len(points) < len(patterns) or are_enough


def best_pose(
    session: Session,
    body: Body,
    number: int,
    views: Views,
    guesses: float = np.inf,
    useful: float = -np.inf,
) -> tuple[ScoredPose | None, int]:
    """Search for the best pose of a frame; return it and the number of guesses made.

    The search may end early, without a pose, if none with `useful` evidence is in sight.
    """
    tracker, track = begin(replace(session, body=body))
    search = replace(tracker.rules.search, max_guesses=guesses, useful=useful)
    tracker = replace(tracker, rules=replace(tracker.rules, search=search))
    with np.errstate(all="ignore"), one_blas_thread():  # a changed body may be anywhere
        data = tracker.data(track, number, _TIME_S, views)
        ranked = tracker.explain(data)
    made = sum(report.made for report, _ in data.searches)
    return (ranked[0] if ranked else None), made


def pose_near(
    session: Session, body: Body, number: int, views: Views, T_world_object: Floats
) -> ScoredPose | None:
    """Fit the pose of a frame from a start (4, 4); return None if no view takes part."""
    tracker, track = begin(replace(session, body=body))
    with np.errstate(all="ignore"), one_blas_thread():
        data = tracker.data(track, number, _TIME_S, views)
        if not data.views:
            return None
        likelihood, start = likelihood_of(data), Start(T_world_object, data.close_uncertainty)
        return likelihood.judge(likelihood.fit(start), start)


@dataclass(frozen=True)
class CameraMatches:
    """Features of the body that one camera met in a frame."""

    name: str
    features: Indices  # (n,)
    observed: Floats  # (n, 2)
    noise: Floats  # (n,) standard deviations, in sensor units; larger for cut spots
    seconds: Floats  # (n,) from the frame's time to the exposure, a guess if unknown

    def only(self, chosen: Mask | slice) -> CameraMatches:
        """Return the matches of the chosen features."""
        pairs = self.features[chosen], self.observed[chosen], self.noise[chosen]
        return CameraMatches(self.name, *pairs, self.seconds[chosen])

    @classmethod
    def of(cls, view: View, pairs: Pairs) -> CameraMatches:
        """Return the matches of a view, each with its moment."""
        seconds = read_times(view.sensor, pairs[1], view.delay + (view.unsure or 0.0), view.readout)
        return cls(view.name, *pairs, np.broadcast_to(seconds, len(pairs[0])))


def matches_of(frames: Sequence[Posed]) -> list[list[CameraMatches]]:
    """Return the matches of poses, frame by frame and camera by camera.

    A camera that mostly misses the body may see it displaced by about as much in all frames: it
    takes the displacement that brings most predicted features to detections, if that matches more.
    """
    cameras: dict[str, list[tuple[int, View]]] = {}
    for f, (views, pose) in enumerate(frames):
        for view in views:
            if is_camera(view) and view.name in pose.matches.names:
                cameras.setdefault(view.name, []).append((f, view))
    by_frame: list[list[CameraMatches]] = [[] for _ in frames]
    for name, camera_frames in cameras.items():
        matches = [frames[f][1].matches for f, _ in camera_frames]
        rows = [m.names.index(name) for m in matches]
        pairs = [_met(m, k) for m, k in zip(matches, rows)]
        expected = sum(float(m.expected[k]) for m, k in zip(matches, rows))
        if _count(pairs) < _MISSED * expected:
            predicted = [
                (np.flatnonzero(m.weights[k] > 0), m.places[k]) for m, k in zip(matches, rows)
            ]
            pairs = max(pairs, _shifted([view for _, view in camera_frames], predicted), key=_count)
        for (f, view), met in zip(camera_frames, pairs):
            if len(met[0]):
                by_frame[f].append(CameraMatches.of(view, met))
    return by_frame


def nearest_to_missed(frames: Sequence[Posed]) -> list[list[CameraMatches]]:
    """Match each missed feature to the nearest unclaimed detection, frame by frame."""
    by_frame = []
    for views, pose in frames:
        matches, nearest = pose.matches, list[CameraMatches]()
        for view in filter(is_camera, views):
            if view.name not in matches.names:
                continue
            k = matches.names.index(view.name)
            features = np.flatnonzero((matches.weights[k] > 0) & (matches.shares[k] <= 0.5))
            claimed = matches.detections[k, matches.shares[k] > 0.5]
            unclaimed = np.setdiff1d(np.arange(len(_pattern(view).points)), claimed)
            if len(features) and len(unclaimed):
                reach = _NEARBY * view.observation.sigma
                distances, indices = cKDTree(_pattern(view).points[unclaimed]).query(
                    matches.places[k, features], distance_upper_bound=reach
                )
                is_near = np.isfinite(distances)
                pairs = _pairs(view, features[is_near], unclaimed[indices[is_near]])
                nearest.append(CameraMatches.of(view, pairs))
        by_frame.append(nearest)
    return by_frame


def is_camera(view: View) -> bool:
    """Test whether a view holds points in the image of a camera with a centre."""
    has_points = isinstance(view.observation.pattern, PointPattern)
    return has_points and isinstance(view.sensor, Camera)


def _pattern(view: View) -> PointPattern:
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    return pattern


def _pairs(view: View, features: Indices, detections: Indices) -> Pairs:
    pattern, noise = _pattern(view), NOISE_OF_SIGMA * view.observation.sigma
    deviations = np.hypot(noise, np.broadcast_to(pattern.deviations, pattern.size))
    return features, pattern.points[detections], deviations[detections]


def _count(pairs: Sequence[Pairs]) -> int:
    return sum(len(features) for features, *_ in pairs)


def _met(matches: Matches, k: int) -> Pairs:
    """Return the features that sensor k met, with places of detections and noise."""
    features = np.flatnonzero(matches.shares[k] > 0.5)
    observed = matches.places[k, features] + matches.sigmas[k] * matches.offsets[k, features]
    deviations = np.sqrt(NOISE_OF_SIGMA**2 + matches.extra[k, features])
    return features, observed, matches.sigmas[k] * deviations


def _shifted(views: Sequence[View], predicted: Sequence[tuple[Indices, Floats]]) -> list[Pairs]:
    """Pair features with detections by the one displacement of all views that pairs most."""
    detections, sensor = [_pattern(view).points for view in views], views[0].sensor
    assert isinstance(sensor, Camera)
    differences = np.concatenate(
        [(d[:, None] - y[None, i]).reshape(-1, 2) for d, (i, y) in zip(detections, predicted)]
    )
    farthest = _FARTHEST * 2 * float(sensor.camera_matrix[0, 2])
    differences = differences[np.linalg.norm(differences, axis=1) < farthest][:_DISPLACEMENTS]
    trees, near = [cKDTree(d) for d in detections], _REACH * views[0].observation.sigma

    def hits(shift: Any) -> list[Pairs]:
        pairs = []
        for tree, view, (i, places) in zip(trees, views, predicted):
            distances, nearest = tree.query(places[i] + shift, distance_upper_bound=near)
            pairs.append(_pairs(view, i[np.isfinite(distances)], nearest[np.isfinite(distances)]))
        return pairs

    return max(map(hits, differences), key=_count, default=[])

"""How well frames are explained by a body and sensors, as they are given or as they may be.

And which feature was met by which detection, for values that are fitted to several frames.
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
Pairs: TypeAlias = tuple[Indices, Floats, Floats]  # as in `Seen`
Posed: TypeAlias = tuple[Sequence[View], ScoredPose]

_BEGIN_S = 0.0  # of the first frame, of which the time tells nothing but that sensors have one
_FEW = 3  # features in view that tell of a pose
_FEWEST = 0.1  # of the body's features, without which no pose is told
_MISSED = 0.3  # of the body: a camera that meets less mostly misses it
_REACH = 3.0  # times sigma, from a displaced feature to its detection
_BESIDE = 10.0  # times sigma, from a feature that is missed to a detection that may be its own
_AWAY = 0.15  # of the image, the longest displacement
_DISPLACEMENTS = 2000  # that are tried


@dataclass(frozen=True)
class Explained:
    """The best poses of some frames; None where nothing was seen or found."""

    poses: tuple[ScoredPose | None, ...]

    @property
    def evidence(self) -> float:
        """Log odds of all against clutter, which explains what no pose does."""
        return sum(evidence_of(pose) for pose in self.poses)

    def good(self, rules: DiagnosisRules) -> int:
        """How many frames are explained, by all of their sensors."""
        return sum(pose is not None and is_explained(pose, rules) for pose in self.poses)

    def met(self, feature: int | None = None) -> float:
        """Number of features that sensors meet; how many meet one of them."""
        return sum(
            float(pose.matches.shares[:, _columns(feature)].sum())
            for pose in self.poses
            if pose is not None
        )

    def rms(self, feature: int | None = None) -> float:
        """Root mean square of what features, or one, are met off, in sigma: of the median frame."""
        found = [rms_of(pose, feature) for pose in self.poses if pose is not None]
        return float(np.median([each for each in found if np.isfinite(each)] or [0.0]))


def evidence_of(pose: ScoredPose | None) -> float:
    """Log odds of a pose against clutter, 0 at least."""
    return 0.0 if pose is None else max(pose.log_evidence, 0.0)


def rms_of(pose: ScoredPose, feature: int | None = None) -> float:
    """Root mean square offset of a pose, or of a feature there, in sigma; NaN of none."""
    matches, noise = pose.matches, NOISE_OF_SIGMA**2
    # a cut spot counts as far as it is exact
    shares = (matches.shares * (noise / (noise + matches.extra)))[:, _columns(feature)]
    total = float(shares.sum())
    squares = float((shares * matches.squared[:, _columns(feature)]).sum())
    return float(np.sqrt(squares / total)) if total > 0 else np.nan


def _columns(feature: int | None) -> slice:
    return slice(feature, None if feature is None else feature + 1)


def is_explained(pose: ScoredPose, rules: DiagnosisRules) -> bool:
    """Whether a pose is sure, and no sensor sees much beside what it meets."""
    matches = pose.matches
    # what a sensor sees of which the body is out of its view is no body, or the view is wrong; a
    # feature or two there are met by any change
    in_view = np.where(matches.expected >= _FEW, matches.expected, matches.expected.max())
    could = np.minimum(matches.count, in_view)
    return bool(
        pose.log_evidence > rules.sure
        and not pose.left_out
        and (matches.met >= rules.met * could).all()
    )


def is_well_explained(pose: ScoredPose | None, rules: DiagnosisRules) -> bool:
    """Whether what is met is met to within what good recordings err by, too."""
    return pose is not None and is_explained(pose, rules) and rms_of(pose) < rules.noise


def anywhere(session: Session) -> Session:
    """The session without a start, where none is needed: it may be what is wrong."""
    return replace(session, start=None) if free_mask(session.estimator).all() else session


def estimate_of(session: Session, number: int, views: Views) -> Estimate:
    """What a run tells of a frame that is its first."""
    tracker, track = begin(session)
    return tracker.advance(track, number, _BEGIN_S, views)[1]


def can_tell(views: Views, features: int) -> bool:
    """Whether detections have more coordinates than a pose, which meets as many as it has itself.

    And are a tenth of the body's features at least: each that is met gains up to ten nats against
    clutter, and one that is missed costs two.
    """
    patterns = [view.observation.pattern for view in views]
    points = [each.points for each in patterns if isinstance(each, PointPattern)]
    are_few = max(map(len, points), default=0) < _FEWEST * features
    are_enough = sum(each.size for each in points) > len(TWIST_NAMES) and not are_few
    return len(points) < len(patterns) or are_enough


def best_pose(
    session: Session,
    body: Body,
    number: int,
    views: Views,
    guesses: float = np.inf,
    useful: float = -np.inf,
) -> tuple[ScoredPose | None, int]:
    """The best pose of a frame, searched for with as many guesses at most, and how many it took.

    Where no pose with `useful` evidence is in sight, there may be none.
    """
    tracker, track = begin(replace(session, body=body))
    search = replace(tracker.rules.search, max_guesses=guesses, useful=useful)
    tracker = replace(tracker, rules=replace(tracker.rules, search=search))
    with np.errstate(all="ignore"), one_blas_thread():  # other bodies may be anywhere
        data = tracker.data(track, number, _BEGIN_S, views)
        ranked = tracker.explain(data)
    made = sum(report.made for report, _ in data.searches)
    return (ranked[0] if ranked else None), made


def pose_near(
    session: Session, body: Body, number: int, views: Views, T_world_object: Floats
) -> ScoredPose | None:
    """The pose of a frame near another (4, 4)."""
    tracker, track = begin(replace(session, body=body))
    with np.errstate(all="ignore"), one_blas_thread():
        data = tracker.data(track, number, _BEGIN_S, views)
        if not data.views:
            return None
        likelihood, start = likelihood_of(data), Start(T_world_object, data.close_uncertainty)
        return likelihood.judge(likelihood.fit(start), start)


@dataclass(frozen=True)
class Seen:
    """What one camera met of the body in a frame."""

    name: str
    features: Indices  # (n,)
    observed: Floats  # (n, 2)
    noise: Floats  # (n,) standard deviations, in sensor units; of cut spots larger ones
    seconds: Floats  # (n,) after the frame's time that it was seen; where that is unknown, about so

    def only(self, chosen: Mask | slice) -> Seen:
        """Some of the features."""
        features, observed = self.features[chosen], self.observed[chosen]
        return Seen(self.name, features, observed, self.noise[chosen], self.seconds[chosen])

    @classmethod
    def by(cls, view: View, pairs: Pairs) -> Seen:
        """What a view met."""
        seconds = read_times(view.sensor, pairs[1], view.delay + (view.unsure or 0.0), view.readout)
        return cls(view.name, *pairs, np.broadcast_to(seconds, len(pairs[0])))


def seen_by(frames: Sequence[Posed]) -> list[list[Seen]]:
    """What poses met, frame by frame and camera by camera.

    A camera that mostly misses the body may see it elsewhere, and about as far off in all frames:
    by the displacement that brings most of the predicted features upon detections.
    """
    cameras: dict[str, list[tuple[int, View]]] = {}
    for f, (views, pose) in enumerate(frames):
        for view in views:
            if is_camera(view) and view.name in pose.matches.names:
                cameras.setdefault(view.name, []).append((f, view))
    seen: list[list[Seen]] = [[] for _ in frames]
    for name, own in cameras.items():
        matches = [frames[f][1].matches for f, _ in own]
        rows = [each.names.index(name) for each in matches]
        pairs = [_met(each, k) for each, k in zip(matches, rows)]
        expected = sum(float(each.expected[k]) for each, k in zip(matches, rows))
        if _count(pairs) < _MISSED * expected:
            predicted = [
                (np.flatnonzero(each.weights[k] > 0), each.places[k])
                for each, k in zip(matches, rows)
            ]
            pairs = max(pairs, _shifted([view for _, view in own], predicted), key=_count)
        for (f, view), met in zip(own, pairs):
            if len(met[0]):
                seen[f].append(Seen.by(view, met))
    return seen


def beside(frames: Sequence[Posed]) -> list[list[Seen]]:
    """Features that were missed, with the nearest detection that belongs to none."""
    found = []
    for views, pose in frames:
        matches, own = pose.matches, list[Seen]()
        for view in filter(is_camera, views):
            if view.name not in matches.names:
                continue
            k = matches.names.index(view.name)
            features = np.flatnonzero((matches.weights[k] > 0) & (matches.shares[k] <= 0.5))
            taken = matches.detections[k, matches.shares[k] > 0.5]  # by which features are met
            free = np.setdiff1d(np.arange(len(_pattern(view).points)), taken)
            if len(features) and len(free):
                near = _BESIDE * view.observation.sigma
                away, at = cKDTree(_pattern(view).points[free]).query(
                    matches.places[k, features], distance_upper_bound=near
                )
                is_near = np.isfinite(away)
                own.append(Seen.by(view, _pairs(view, features[is_near], free[at[is_near]])))
        found.append(own)
    return found


def is_camera(view: View) -> bool:
    """Whether a view holds points in the image of a camera with a centre."""
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
    features = np.flatnonzero(matches.shares[k] > 0.5)
    observed = matches.places[k, features] + matches.sigmas[k] * matches.offsets[k, features]
    deviations = np.sqrt(NOISE_OF_SIGMA**2 + matches.extra[k, features])
    return features, observed, matches.sigmas[k] * deviations


def _shifted(views: Sequence[View], predicted: Sequence[tuple[Indices, Floats]]) -> list[Pairs]:
    """Features and the detections upon which one displacement of all brings them."""
    detections, sensor = [_pattern(view).points for view in views], views[0].sensor
    assert isinstance(sensor, Camera)
    differences = np.concatenate(
        [(d[:, None] - y[None, i]).reshape(-1, 2) for d, (i, y) in zip(detections, predicted)]
    )
    far = _AWAY * 2 * float(sensor.camera_matrix[0, 2])
    differences = differences[np.linalg.norm(differences, axis=1) < far][:_DISPLACEMENTS]
    trees, near = [cKDTree(d) for d in detections], _REACH * views[0].observation.sigma

    def hits(shift: Any) -> list[Pairs]:
        found = []
        for tree, view, (i, y) in zip(trees, views, predicted):
            away, at = tree.query(y[i] + shift, distance_upper_bound=near)
            found.append(_pairs(view, i[np.isfinite(away)], at[np.isfinite(away)]))
        return found

    return max(map(hits, differences), key=_count, default=[])

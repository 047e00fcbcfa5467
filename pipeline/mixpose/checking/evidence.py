"""How well frames are explained by a body and sensors, as they are given or as they may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from mixpose.body import Body
from mixpose.checking.lookalikes import NOISE_OF_SIGMA
from mixpose.checking.rules import DiagnosisRules
from mixpose.fit import free_mask
from mixpose.judgement import ScoredPose
from mixpose.objective import View
from mixpose.records import Floats
from mixpose.runner import begin
from mixpose.session import Session
from mixpose.threads import one_blas_thread
from mixpose.tracking.frame import Start
from mixpose.tracking.likelihood import likelihood_of

Views: TypeAlias = Sequence[View]
Frames: TypeAlias = Sequence[tuple[int, Views]]


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
    # what a sensor sees of which the body is out of its view is no body, or the view is wrong
    in_view = np.where(matches.expected > 0, matches.expected, matches.expected.max())
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


def best_pose(
    session: Session, body: Body, number: int, views: Views, guesses: float = np.inf
) -> ScoredPose | None:
    """The best pose of a frame, searched for with as many guesses at most."""
    tracker, track = begin(replace(session, body=body))
    search = replace(tracker.rules.search, max_guesses=guesses)
    tracker = replace(tracker, rules=replace(tracker.rules, search=search))
    with np.errstate(all="ignore"), one_blas_thread():  # other bodies may be anywhere
        ranked = tracker.explain(tracker.data(track, number, None, views))
    return ranked[0] if ranked else None


def pose_near(
    session: Session, body: Body, number: int, views: Views, T_world_object: Floats
) -> ScoredPose | None:
    """The pose of a frame near another (4, 4)."""
    tracker, track = begin(replace(session, body=body))
    with np.errstate(all="ignore"), one_blas_thread():
        data = tracker.data(track, number, None, views)
        if not data.views:
            return None
        likelihood, start = likelihood_of(data), Start(T_world_object, data.close)
        return likelihood.judge(likelihood.fit(start), start)

"""What an estimate reports beside the pose: its covariance, and the offsets of features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.body import Body
from mixpose.judgement import Curved, ScoredPose, with_likely_turns, with_wide_turn
from mixpose.matching import Matches
from mixpose.objective import project_body
from mixpose.records import Floats, Offsets
from mixpose.rigid import covariance_at
from mixpose.search import is_pointlike
from mixpose.tracking.frame import Frame


def reported_covariances(
    poses: Sequence[tuple[Frame, ScoredPose | None, Floats]],
) -> list[Floats | None]:
    """Return covariances (6, 6) at points (3,) of bodies, with all likely turns; None of no pose.

    The bodies have the same free directions.
    """
    curved = dict[int, Curved]()
    for k, (data, pose, _) in enumerate(poses):
        if pose is not None and pose.spread is None and is_pointlike(data.body):
            sensors = tuple([view.sensor for view in data.views if view.name not in pose.left_out])
            at = pose.covariance, pose.T_world_object, pose.used, pose.variances
            curved[k] = Curved(*at, project_body(sensors, data.body))
    turned = dict(zip(curved, with_likely_turns([*curved.values()], poses[0][0].free), strict=True))
    covariances = list[Floats | None]()
    for k, (data, pose, origin) in enumerate(poses):
        if pose is None:
            covariances.append(None)
            continue
        T, points = pose.T_world_object, data.body.means - origin
        covariance = covariance_at(turned.get(k, pose.covariance), T[:3, :3] @ origin)
        covariances.append(with_wide_turn(covariance, T, points))
    return covariances


def residuals_of(used: Matches, body: Body) -> dict[str, dict[str, float | None]]:
    """Return the distance at which each sensor met features in view; None for missed ones."""
    distances = used.sigmas[:, None] * np.sqrt(used.squared)
    rows = zip(distances.tolist(), used.shares.tolist(), used.weights.tolist(), strict=True)
    return {
        name: {label: r if s else None for label, r, s, w in zip(body.labels, *row) if w}
        for name, row in zip(used.names, rows, strict=True)
    }


def offsets_of(used: Matches, variances: Floats) -> dict[str, Offsets]:
    """Return the offsets of met features by sensor, for a body of points.

    Noise has variances (L,), σ_ε².
    """
    offsets = {}
    for k, (name, m, sigma) in enumerate(zip(used.names, used.dimensions, used.sigmas.tolist())):
        i = np.flatnonzero(used.weights[k])
        y, by_shift = sigma * used.offsets[k, i, :m], used.J[k, i, :m, :3]
        detections, places = used.detections[k, i], used.places[k, i, :m]
        is_same = (detections[:, None] == detections) & (detections >= 0)[:, None]
        shared = is_same.sum(axis=1) > 1
        # two features that share a detection have the offset of their middle
        middle = is_same @ places / np.maximum(is_same.sum(axis=1), 1)[:, None]
        observed = np.where(shared[:, None], middle, places) + y
        met = used.shares[k, i] > 0
        weights = variances[k] / (variances[k] + used.extra[k, i])
        offsets[name] = Offsets(i, met, y, sigma * by_shift, observed, shared, weights)
    return offsets

"""Odds, by all frames together, of a body against another rigid thing that looks like it.

One view of n points fixes only 2n − 6 of their 3n coordinates, six being the pose: another rigid
thing may look the same from there, but not from another side.  Residuals r of all frames
have, with the poses taken out, the information S = Σ JᵀJ about the places of the features and the
vector v = Σ Jᵀr, for noise of σ_ε.  With errors of the places of variance p, and noise s, they are
as likely as

    s^−ν det (I + S p / s²)^−½ exp −(rᵀr − vᵀ (S + s²/p)⁻¹ v) / 2 s²;

For another thing p is the square of the body's radius; for the body it is that of the noise, as a
lens or a drawing that is a little wrong is so in all frames.  For both, s is unknown, alike in all
frames, and by its prior near the usual noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from mixpose.body import Body
from mixpose.judgement.information import inverted
from mixpose.judgement.noise import NoiseModel
from mixpose.matching import Matches
from mixpose.objective import pose_jacobian
from mixpose.records import Floats

TURNED = 2 * float(chdtri(3, 1e-6))
"""Squared deviations between two poses, exceeded once in a million; less is the same view."""

NOISE = np.geomspace(0.01, 1.0, 25) ** 2  # s², σ_ε²


class Shape(NamedTuple):
    """Information of frames about the places of a body's features, for noise of σ_ε."""

    information: Floats  # (3 N, 3 N), length⁻²
    vector: Floats  # (3 N,), length⁻¹
    squares: float  # of the residuals
    degrees: float  # of freedom
    reach: float  # σ_ε² at the body in the last frame, length²
    side: Floats  # (3, 3), rotation from body to world at the last view from another side
    alone: float  # log odds of the last frame by itself
    spent: float = 0.0  # minus the log odds that choosing the pose cost, in the costliest frame

    def log_odds(self, radius: float, model: NoiseModel) -> float:
        """Return the larger log odds of the body: by the last frame alone, or by all frames."""
        return max(self.alone, self.spent + self.by_all_frames(radius, model))

    def by_all_frames(self, radius: float, model: NoiseModel) -> float:
        """Return the log odds against another rigid thing that looks the same by chance."""
        values, axes = np.linalg.eigh(self.information)
        values, pulls = np.maximum(values, 0.0), (self.vector @ axes) ** 2
        before = model.errors.typical_degrees
        squares, degrees = self.squares + before * model.usual**2, self.degrees + before
        noise = NOISE[:, None]
        body, other = (
            np.logaddexp.reduce(
                0.5 * np.vecdot(pulls, p / (values * p + noise)) / NOISE
                - 0.5 * np.log1p(values * p / noise).sum(axis=1)
                - 0.5 * (degrees * np.log(NOISE) + squares / NOISE)
            )
            for p in (self.reach * noise, radius**2)
        )
        return float(body - other)


def shape_shown(
    met: Matches,
    variances: Floats,  # (L,) of the noise, σ_ε²
    body: Body,
    T_world_object: Floats,
    alone: float,  # log odds of the frame by itself
    model: NoiseModel,
    before: Shape | None,
) -> Shape:
    """Add the features that a pose meets to the information of the frames `before`, if any."""
    # weighted so that all sensors have the noise of the best
    noise, N = float(variances.min()), met.shares.shape[1]
    weights = met.shares * met.coordinate_weight[:, None] * noise / (variances[:, None] + met.extra)
    roots = np.sqrt(weights).T[..., None]
    by_world = (roots[..., None] * met.J[..., :3].swapaxes(0, 1)).reshape(N, -1, 3)
    r = (roots * met.offsets.swapaxes(0, 1)).reshape(N, -1, 1)
    side = T_world_object[:3, :3]
    J, C = _by_pose(by_world, side, body)
    if before is not None:
        turned = Rotation.from_matrix(side @ before.side.T).as_rotvec()
        if turned @ inverted(C[3:, 3:]) @ turned < TURNED * noise:
            side = before.side
            J, C = _by_pose(by_world, side, body)
    by_place = by_world @ side
    by_place_T, blocks = by_place.swapaxes(1, 2), by_place.swapaxes(1, 2) @ by_place
    by_pose = (by_place_T @ J.reshape(N, -1, 6)).reshape(-1, 6)
    information = -by_pose @ C @ by_pose.T
    information.reshape(N, 3, N, 3)[range(N), :, range(N)] += blocks
    vector = (by_place_T @ r).ravel() - by_pose @ (C @ (J.T @ r.ravel()))
    count, squares = float(met.measurements.sum()), float(np.vdot(r, r))
    reach = count / max(float(np.trace(blocks.sum(axis=0))), 1e-300)
    shape = Shape(information, vector, squares, count - 6, reach, side, alone)
    shape = shape._replace(spent=alone - shape.by_all_frames(body.radius, model))
    if before is None:
        return shape
    return shape._replace(
        information=before.information + information,
        vector=before.vector + vector,
        squares=before.squares + squares,
        degrees=before.degrees + shape.degrees,
        spent=min(before.spent, shape.spent),
    )


def _by_pose(by_world: Floats, R: Floats, body: Body) -> tuple[Floats, Floats]:
    """Return the Jacobian (R, 6) by a pose of rotation R, and its covariance, wide if not shown."""
    J = pose_jacobian(by_world, body.nodes.points @ R.T).reshape(-1, 6)
    information = J.T @ J
    least = 1e-9 * np.trace(information[:3, :3])
    return J, inverted(information + least * np.diag([1.0] * 3 + [body.radius**2] * 3))

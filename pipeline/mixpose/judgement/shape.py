"""How far frames together tell a body from another rigid thing that has its shape by chance.

One view of n points leaves all but 2n − 6 of the 3n coordinates open, of which six are a pose: what
else is rigid may look the same from there, but not from another side.  Residuals r of all frames
have, with the poses taken out, the information S = Σ JᵀJ about the places of the features and the
vector v = Σ Jᵀr, for noise of σ_ε.  With errors of the places of variance p, and noise s, they are
as likely as

    s^−ν det (I + S p / s²)^−½ exp −(rᵀr − vᵀ (S + s²/p)⁻¹ v) / 2 s²;

p is the square of the body's radius for another thing, and for the body that of the noise, which
lasts where a lens or a drawing is a little wrong.  Neither knows s, which is alike in all frames,
and before them what is usual.
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
"""What two poses err by, squared, but for one in a million: what turned less shows one side."""

NOISE = np.geomspace(0.01, 1.0, 25) ** 2  # s², σ_ε²


class Shape(NamedTuple):
    """What frames say of the places of a body's features, for noise of σ_ε."""

    information: Floats  # (3 N, 3 N), length⁻²
    vector: Floats  # (3 N,), length⁻¹
    squares: float  # of the residuals
    degrees: float  # of freedom
    reach: float  # of σ_ε in the last frame, length²
    side: Floats  # (3, 3), the turn of the body to the world, as the last other side had it
    alone: float  # log odds of the last frame by itself
    spent: float = 0.0  # on choosing the pose: what that lacks, in the frame that lacks most

    def log_odds(self, radius: float, model: NoiseModel) -> float:
        """Of the body against other things, by the last frame alone or by all."""
        return max(self.alone, self.spent + self.told(radius, model))

    def told(self, radius: float, model: NoiseModel) -> float:
        """Log odds against another rigid thing that looks the same by chance."""
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
    """By what a pose meets, and by the frames `before`, if it goes on from these."""
    # as if all sensors had the noise of the best
    noise, N = float(variances.min()), met.shares.shape[1]
    weights = met.shares * met.each_part[:, None] * noise / (variances[:, None] + met.extra)
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
    own = by_world @ side
    own_T, blocks, each = own.swapaxes(1, 2), own.swapaxes(1, 2) @ own, np.arange(N)
    both = (own_T @ J.reshape(N, -1, 6)).reshape(-1, 6)
    information = -both @ C @ both.T
    information.reshape(N, 3, N, 3)[each, :, each] += blocks
    vector = (own_T @ r).ravel() - both @ (C @ (J.T @ r.ravel()))
    count, squares = float(met.measurements.sum()), float(np.vdot(r, r))
    reach = count / max(float(np.trace(blocks.sum(axis=0))), 1e-300)
    one = Shape(information, vector, squares, count - 6, reach, side, alone)
    one = one._replace(spent=alone - one.told(body.radius, model))
    if before is None:
        return one
    return one._replace(
        information=before.information + information,
        vector=before.vector + vector,
        squares=before.squares + squares,
        degrees=before.degrees + one.degrees,
        spent=min(before.spent, one.spent),
    )


def _by_pose(by_world: Floats, R: Floats, body: Body) -> tuple[Floats, Floats]:
    """Jacobian (R, 6) by a pose turned so, and its covariance; what nothing shows is wide."""
    J = pose_jacobian(by_world, body.nodes.points @ R.T).reshape(-1, 6)
    information = J.T @ J
    least = 1e-9 * np.trace(information[:3, :3])
    return J, inverted(information + least * np.diag([1.0] * 3 + [body.radius**2] * 3))

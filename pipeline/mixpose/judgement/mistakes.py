"""How likely a frame makes it that a sensor stands otherwise than told, or a body is larger.

Residuals r that a pose leaves are noise of a variance s² that nobody knows, fields of sensors and
markers that are usual, of the deviation d, and, by the mistake in question, columns C of known
deviations.  With the eigenvalues λ and vectors U of XᵀX, X = [C | F d] less what a pose takes up,
and z = UᵀXᵀr, in ν directions,

    ln p(r | s) = −½ ν ln s² − ½ (|r|² − Σ z² / (λ + s²)) / s² − ½ Σ ln (1 + λ / s²),

of which the sum over s, even in ln s, and over d is what a hypothesis is worth.  It counts where
the pose, with its noise, is then outside its ellipsoid: it moves by δ = −(JᵀJ)⁻¹ JᵀC γ, of sizes γ
that residuals tell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from mixpose.body import Body
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.noise import NoiseModel, fields_of_sensors, inverted
from mixpose.records import Floats, Mask

APART = "sensors contradict each other"
SIZE = "the body seems to be of another size"


def possible_mistakes(
    pose: ScoredPose, body: Body, free: Mask, model: NoiseModel
) -> Iterator[tuple[str, float]]:
    """What a frame of several sensors may show as wrong, and the log of how much likelier it is."""
    found, (chosen,) = pose.used, free.nonzero()
    # one sensor has the world stand as it does, and bodies as large as they are far
    if len(found.names) < 2 or not len(chosen):
        return
    noise = pose.variances[:, None]
    shares = found.shares * noise / (noise + found.extra)
    roots, met = np.sqrt(shares).ravel().repeat(2)[:, None], shares.sum(axis=1)
    r, rows = roots[:, 0] * found.offsets.ravel(), roots * found.J.reshape(-1, 6)
    J = rows[:, chosen]
    drawn = inverted(J.T @ J) @ J.T
    r = r - J @ (drawn @ r)
    # noise from a hundredth of σ_ε to twice that
    s2 = np.asarray(1e-4 * 1.6 ** np.arange(24))
    given = r, float(met @ found.dimensions) - len(chosen), s2
    columns, stated = _columns(pose, body, rows, met, model), _stated(pose, body, roots, rows)
    moves = drawn @ columns
    left, stated = columns - J @ moves, stated - J @ (drawn @ stated)
    told, *odds = evidence_of(_beside(left, stated), *given)[0].tolist()
    # what is not likelier by itself is not likelier beside fields
    likelier = [k for k, one in enumerate(odds, 1) if one > told]
    if not likelier:
        return
    # that markers err by 1 σ_ε makes a size, too
    fields = fields_of_sensors(found, shares, met)
    size = columns[1, :, :1]
    fields = np.hstack([fields, size * math.sqrt(len(met) / max(float(np.vdot(size, size)), 1e-9))])
    sizes = np.reshape([0.0, model.bias / 4, model.bias, 2 * model.bias], (-1, 1, 1))
    usual = _beside(sizes * (fields - J @ (drawn @ fields)), stated)
    others = np.logaddexp.reduce(evidence_of(usual, *given)[0])
    own = inverted(pose.covariance[np.ix_(chosen, chosen)])
    limit = float(chdtri(len(chosen), 1 - model.by_chance)) - len(chosen)  # besides noise
    for k in likelier:
        cases, second = evidence_of(_beside(usual, left[k]), *given)
        by_mistake = moves[k] @ second[cases.argmax(), -6:, -6:] @ moves[k].T
        if np.vdot(own, by_mistake) > limit:
            yield SIZE if k == 1 else APART, float(np.logaddexp.reduce(cases) - others)


def _columns(pose: ScoredPose, body: Body, rows: Floats, met: Floats, model: NoiseModel) -> Floats:
    """How residuals change with mistakes (L + 2, R, 6), weighted as rows (R, 6), times deviations.

    With none; with another size of the body, in the first column; with each sensor that is moved.
    """
    L, T = len(met), pose.T_world_object
    columns, by_sensor = np.zeros((L + 2, *rows.shape)), rows.reshape(L, -1, 2, 6)
    away = (body.nodes.points @ T[:3, :3].T)[..., None]
    columns[1, :, 0] = model.turned * (by_sensor[..., :3] @ away).ravel()
    moved = np.sqrt(np.square(by_sensor[..., :3]).sum(axis=(1, 2, 3)) / np.maximum(met, 1e-9))
    for k in range(L):
        deviations = np.repeat([model.shifted / max(float(moved[k]), 1e-9), model.turned], 3)
        columns[k + 2].reshape(L, -1, 6)[k] = rows.reshape(L, -1, 6)[k] * deviations
    return columns


def _stated(pose: ScoredPose, body: Body, roots: Floats, rows: Floats) -> Floats:
    """What the session says that may be off (R, Q): calibrations, and features of the body."""
    by_calibration, found = pose.used.by_calibration, [np.zeros((len(rows), 0))]
    if by_calibration is not None:
        found.append(roots * by_calibration.reshape(len(rows), -1))
    if body.spread:
        values, axes = np.linalg.eigh(body.node_spreads(pose.T_world_object))
        axes *= np.sqrt(np.maximum(values, 0.0))[:, None]
        by_feature = rows.reshape(-1, len(values), 2, 6)[..., :3] @ axes
        own = np.eye(len(values))[:, None, :, None]
        found.append((by_feature[:, :, :, None] * own).reshape(len(rows), -1))
    return np.hstack(found)


def _beside(X: Floats, others: Floats) -> Floats:
    """Columns (K, R, p) with others (R, q), which come last."""
    return np.concatenate([X, np.broadcast_to(others, (len(X), *others.shape))], axis=2)


def evidence_of(X: Floats, r: Floats, degrees: float, s2: Floats) -> tuple[Floats, Floats]:
    """Log evidence (K,) of columns X (K, R, p), of deviation 1; second moments of their sizes.

    For residuals r (R,) of so many degrees of freedom, and noise of any of the variances s2.
    """
    values, U = np.linalg.eigh(X.swapaxes(1, 2) @ X)
    z = ((r @ X)[:, None] @ U)[:, 0, :, None]
    wide = np.maximum(values, 0.0)[..., None] + s2
    left = r @ r - (z**2 / wide).sum(axis=1)
    logs = -0.5 * (degrees * np.log(s2) + left / s2 + np.log(wide / s2).sum(axis=1))
    k = np.arange(len(X))[:, None], np.arange(U.shape[2]), logs.argmax(axis=1)[:, None]
    mean, S = (U * (z[..., 0] / wide[k])[:, None]).sum(axis=2), U * (s2[k[2]] / wide[k])[:, None]
    second = S @ U.swapaxes(1, 2) + mean[:, :, None] * mean[:, None]
    return np.logaddexp.reduce(logs, axis=1), second

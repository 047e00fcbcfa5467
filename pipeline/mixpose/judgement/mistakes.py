"""How likely frames make it that sensors or a body are otherwise than the session tells.

Residuals r that a pose leaves are noise of a variance s² that nobody knows, fields of sensors and
markers that are usual, of the deviation d, and, by the mistake in question, columns C of known
deviations.  With the eigenvalues λ and vectors U of XᵀX, X = [C | F d] less what a pose takes up,
and z = UᵀXᵀr, in ν directions,

    ln p(r | s) = −½ ν ln s² − ½ (|r|² − Σ z² / (λ + s²)) / s² − ½ Σ ln (1 + λ / s²),

of which the sum over s, even in ln s, and over d is what a hypothesis is worth.  It counts as often
as the pose, with its noise, is then outside its ellipsoid: it is δ = −(JᵀJ)⁻¹ JᵀC γ off, of sizes γ
that residuals tell, which adds E = ⟨δᵀΣ⁻¹δ⟩ to a squared error of n.  By one sensor that stands
otherwise it is (JᵀJ)⁻¹ Jᵀ (r − C γ) off: nothing where it follows the others.  Sensors always stand
a little otherwise than told: that counts where n + E is outside.  A session has one mistake of a
kind, at the most, and may have one that leaves the pose in place.

What one frame tells of a session holds in those that follow, which may not tell it themselves: log
odds add up from frame to frame, and never fall below those of a session of which nothing is known
(E. S. Page, Continuous inspection schemes, Biometrika 41, 1954).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from mixpose.body import Body
from mixpose.judgement.fields import fields_of_sensors
from mixpose.judgement.information import inverted
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.noise import NoiseModel
from mixpose.matching import Matches
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import transform
from mixpose.sensors import Sensor, lens_shifts

APART = "sensors contradict each other"
SIZE = "the body seems to be of another size"
LENS = "lenses seem to be others than the session tells"


class Mistake(NamedTuple):
    """Something in the session that may be wrong."""

    name: str  # what tells it from others
    what: str  # in words
    log_odds: float  # by how much likelier frames so far make it
    log_harm: float  # of the probability that it puts this pose outside its ellipsoid


def odds_of_each(mistakes: Sequence[Mistake], likely: Sequence[float]) -> list[float]:
    """Log odds of each mistake against the pose; of a kind a session has one at the most.

    They are so `likely` before any frame.  One that leaves the pose in place tells for it.
    """
    believed = [math.log(p) + one.log_odds for p, one in zip(likely, mistakes, strict=True)]
    right = dict[str, float]()
    for own, one in zip(believed, mistakes, strict=True):
        harmless = own + math.log(max(-math.expm1(one.log_harm), 1e-300))
        right[one.what] = float(np.logaddexp(right.get(one.what, 0.0), harmless))
    return [own + one.log_harm - right[one.what] for own, one in zip(believed, mistakes)]


def possible_mistakes(
    pose: ScoredPose,
    body: Body,
    free: Mask,
    model: NoiseModel,
    sensors: Mapping[str, Sensor],
    before: Mapping[str, float],
) -> Iterator[Mistake]:
    """What of the session frames show as wrong, likelier than before any of them.

    `sensors` by name, as they stand still; `before` are log odds by `Mistake.name`, above zero.
    """
    found, (chosen,) = pose.used, free.nonzero()
    # one sensor has the world stand as it does, and bodies as large as they are far
    if not len(chosen) or (len(found.names) < 2 and not before):
        return
    names = _names_of(found)
    for name in before.keys() - {*names}:
        yield Mistake(name, APART, before[name], -math.inf)
    noise = pose.variances[:, None]
    shares = found.shares * found.each_part[:, None] * noise / (noise + found.extra)
    is_off = model.errors.are_off(found, noise + found.extra)
    # what a pose does not follow tells where sensors stand, and nothing of bodies and lenses, if
    # other sensors do not see it so, too
    is_alone = is_off & (is_off.sum(axis=0) < 2)
    if not np.count_nonzero(is_alone):
        yield from _mistakes(pose, body, chosen, model, sensors, before, names, shares)
        return
    followed = np.where(is_alone, 0.0, shares)
    for asked, some in ((names[1:-1], shares), ([SIZE, LENS], followed)):
        yield from _mistakes(pose, body, chosen, model, sensors, before, asked, some)


def _mistakes(
    pose: ScoredPose,
    body: Body,
    chosen: Indices,  # directions that are free
    model: NoiseModel,
    sensors: Mapping[str, Sensor],
    before: Mapping[str, float],
    asked: Sequence[str],
    shares: Floats,  # (L, N) that features count
) -> Iterator[Mistake]:
    """Those that are asked for, as features show them."""
    found, names = pose.used, _names_of(pose.used)
    roots, met = np.sqrt(shares).ravel().repeat(2)[:, None], shares.sum(axis=1)
    seen, rows = roots[:, 0] * found.offsets.ravel(), roots * found.J.reshape(-1, 6)
    J = rows[:, chosen]
    drawn = inverted(J.T @ J) @ J.T
    r = seen - J @ (drawn @ seen)
    # noise from a hundredth of σ_ε to twice that
    s2 = np.asarray(1e-4 * 1.6 ** np.arange(24))
    given = r, float(met @ found.dimensions) - len(chosen), s2
    columns, stated = _columns(pose, body, rows, met, model), _stated(pose, body, roots, rows)
    lenses = roots * _by_lenses(pose, body, model, sensors)
    columns = _widened(columns, lenses)
    left, stated = columns - J @ (drawn @ columns), stated - J @ (drawn @ stated)
    which = [k for k, name in enumerate(names) if name in asked]
    some = left[[0, *(k + 1 for k in which)]]
    told, *odds = evidence_of(_beside(some, stated), *given)[0].tolist()
    known = [before.get(name, 0.0) for name in names]
    # what is not likelier by itself is not likelier beside fields
    likelier = [k for k, one in zip(which, odds, strict=True) if one + known[k] > told]
    if not likelier:
        return
    fields = _fields(found, shares, columns[1, :, :1])
    fields = fields - J @ (drawn @ fields)
    usual = _beside(_usual(fields, left[-1, :, : lenses.shape[1]], model), stated)
    others = evidence_of(usual, *given)[0]
    own = inverted(pose.covariance[np.ix_(chosen, chosen)])
    # where sensors put the pose that are as exact as they are, which matters where one is wrong and
    # not all: one that the pose does not follow leaves it in place
    exact = np.repeat(pose.variances.min() / pose.variances, 2 * shares.shape[1])[:, None] * J
    pulled = inverted(exact.T @ J) @ exact.T
    there, moves = pulled @ seen, drawn @ columns
    moves[2:-1] = pulled @ columns[2:-1]
    for k in likelier:
        # a sensor that stands otherwise takes up what its lens is usually off by
        is_sensor = names[k] not in (SIZE, LENS)
        layers = slice(len(usual) // 2 if is_sensor else None)
        logs, means, spreads = evidence_of(_beside(usual[layers], left[k + 1]), *given)
        best, moved, width = logs.argmax(), moves[k + 1], columns.shape[2]
        off = is_sensor * there - moved @ means[best, -width:]
        by_mistake = moved @ spreads[best, -width:, -width:] @ moved.T + np.outer(off, off)
        gained = float(np.logaddexp.reduce(logs) - np.logaddexp.reduce(others[layers]))
        outside = _outside(float(np.vdot(own, by_mistake)), len(chosen), 1 - model.by_chance)
        what = APART if is_sensor else names[k]
        yield Mistake(names[k], what, known[k] + gained, outside[is_sensor])


def _names_of(found: Matches) -> list[str]:
    """What mistakes are of, in the order of `_columns`: a size, each sensor, and lenses."""
    firsts = np.unique(found.owner, return_index=True)[1].tolist()
    return [SIZE, *[found.names[k] for k in firsts], LENS]


def _outside(squared: float, directions: int, chance: float) -> tuple[float, float]:
    """Log probability beyond chance of a pose outside its ellipsoid; and 0 or −∞, if it is likely.

    The ellipsoid holds all but `chance`, and the squared error is expected to be so much larger.
    """
    limit = float(chdtri(directions, chance))
    often = float(chdtrc(directions, limit / (1 + squared / directions))) - chance
    is_likely = squared > limit - directions
    return math.log(max(often, 1e-300)), 0.0 if is_likely else -math.inf


def _columns(pose: ScoredPose, body: Body, rows: Floats, met: Floats, model: NoiseModel) -> Floats:
    """How residuals change with mistakes (S + 2, R, 6), weighted as rows (R, 6), times deviations.

    With none; with another size of the body, in the first column; with each sensor that is moved.
    """
    used, T = pose.used, pose.T_world_object
    S, L = len(used.images), len(met)
    columns, by_sensor = np.zeros((S + 2, *rows.shape)), rows.reshape(L, -1, 2, 6)
    away = (body.nodes.points @ T[:3, :3].T)[..., None]
    columns[1, :, 0] = model.turned * (by_sensor[..., :3] @ away).ravel()
    squares = used.summed(np.square(by_sensor[..., :3]).sum(axis=(1, 2, 3)))
    moved = np.sqrt(squares / np.maximum(used.summed(met), 1e-9))
    deviations = np.full((S, 1, 6), model.turned)
    deviations[..., :3] = (model.shifted / np.maximum(moved, 1e-9))[:, None, None]
    deviations *= S > 1  # one sensor has the world stand as it does
    each = rows.reshape(L, -1, 6) * deviations[used.owner]
    columns[2:].reshape(S, L, -1, 6)[used.owner, range(L)] = each
    return columns


def _by_lenses(
    pose: ScoredPose, body: Body, model: NoiseModel, sensors: Mapping[str, Sensor]
) -> Floats:
    """How residuals change with lenses of another distortion (R, L), times its deviation."""
    found, points = pose.used, transform(pose.T_world_object, body.nodes.points)
    shifts = np.zeros(found.offsets.shape)
    if sensors:
        shifts = lens_shifts(tuple([sensors[name] for name in found.names]), model.lens, points)
    shifts *= (found.weights > 0)[..., None] / found.sigmas[:, None, None]
    L = len(shifts)
    columns = np.zeros((*shifts.shape, L))
    columns[range(L), ..., range(L)] = shifts
    return columns.reshape(-1, L)


def _widened(columns: Floats, more: Floats) -> Floats:
    """Columns (K + 1, R, p) of K mistakes (K, R, 6) and one more (R, q), filled up with zeros."""
    K, R, own = columns.shape
    widened = np.zeros((K + 1, R, max(own, more.shape[1])))
    widened[:-1, :, :own], widened[-1, :, : more.shape[1]] = columns, more
    return widened


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


def _fields(found: Matches, shares: Floats, size: Floats) -> Floats:
    """Fields (R, q) that are usual, of 1 σ_ε: of sensors, and that markers err by makes a size."""
    L = len(shares)
    size = size * math.sqrt(L / max(float(np.vdot(size, size)), 1e-9))
    return np.hstack([fields_of_sensors(found, shares, shares.sum(axis=1)), size])


def _usual(fields: Floats, lenses: Floats, model: NoiseModel) -> Floats:
    """Columns (8, R, q + L) of what sensors and markers usually err by, as a pose leaves them.

    Calibrations have lenses exactly, or at a tenth of what they are off by if they are others.
    """
    sizes = np.reshape([0.0, model.bias / 4, model.bias, 2 * model.bias], (-1, 1, 1))
    return np.concatenate([_beside(sizes * fields, share * lenses) for share in (0.0, 0.1)])


def _beside(X: Floats, others: Floats) -> Floats:
    """Columns (K, R, p) with others (R, q), which come last."""
    K, R, p = X.shape
    both = np.empty((K, R, p + others.shape[-1]))
    both[..., :p], both[..., p:] = X, others
    return both


def evidence_of(X: Floats, r: Floats, degrees: float, s2: Floats) -> tuple[Floats, Floats, Floats]:
    """Log evidence (K,) of columns X (K, R, p), of deviation 1; means, covariances of their sizes.

    For residuals r (R,) of so many degrees of freedom, and noise of any of the variances s2.
    """
    values, U = np.linalg.eigh(X.swapaxes(1, 2) @ X)
    z = ((r @ X)[:, None] @ U)[:, 0, :, None]
    wide = np.maximum(values, 0.0)[..., None] + s2
    left = r @ r - (z**2 / wide).sum(axis=1)
    logs = -0.5 * (degrees * np.log(s2) + left / s2 + np.log(wide / s2).sum(axis=1))
    k = np.arange(len(X))[:, None], np.arange(U.shape[2]), logs.argmax(axis=1)[:, None]
    mean, S = (U * (z[..., 0] / wide[k])[:, None]).sum(axis=2), U * (s2[k[2]] / wide[k])[:, None]
    return np.logaddexp.reduce(logs, axis=1), mean, S @ U.swapaxes(1, 2)

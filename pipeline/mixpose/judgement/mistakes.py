"""Odds that the session is wrong about its sensors or a body, by the residuals of frames.

The residuals r of a pose are noise of unknown variance s², the usual fields F of sensors and
markers, of deviation d, and, if there is a mistake, columns C of known deviations.  With the
eigenvalues λ and vectors U of XᵀX, X = [C | F d] less what a pose absorbs, and z = UᵀXᵀr, in ν
directions,

    ln p(r | s) = −½ ν ln s² − ½ (|r|² − Σ z² / (λ + s²)) / s² − ½ Σ ln (1 + λ / s²),

whose sum over s, even in ln s, and over d is the evidence of a hypothesis.  It counts as often as
the pose is then outside its ellipsoid.  The pose is δ = −(JᵀJ)⁻¹ JᵀC γ off, with sizes γ by the
residuals, which adds E = ⟨δᵀΣ⁻¹δ⟩ to a squared error of n.  If one sensor stands otherwise it is
(JᵀJ)⁻¹ Jᵀ (r − C γ) off: not at all if it follows the others.  Sensors always stand a little
otherwise than the session says: that counts if n + E is outside.  A session has at most one mistake
of a kind, which may leave the pose in place.

What one frame shows of a session holds in later ones, which may not show it: log odds add up from
frame to frame, and never fall below those of a session of which nothing is known (E. S. Page,
Continuous inspection schemes, Biometrika 41, 1954).  From a frame on whose residuals are larger
than chance makes, a sensor that stands otherwise stays so: the posterior of its γ is the prior of
the next frame.  A camera that was turned by a tenth of a degree is so told by two or three frames,
where noise explains each alone as well.  What was wrong before belongs to the usual residuals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.special import chdtrc, chdtri

from mixpose.body import Body
from mixpose.judgement.fields import fields_of_sensors
from mixpose.judgement.information import inverted
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.noise import NoiseModel
from mixpose.matching import Matches
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import transform, twists_at
from mixpose.sensors import Sensor, lens_shifts

APART = "sensors contradict each other"
SIZE = "the body seems to be of another size"
LENS = "lenses seem to be others than the session tells"


Noise: TypeAlias = tuple[Floats, float, Floats]
"""Residuals (R,), their degrees of freedom, and variances of noise that are tried."""


class Sizes(NamedTuple):
    """The sizes of a mistake: of a sensor a twist of the world, as it sees it."""

    mean: Floats  # (w,)
    covariance: Floats  # (w, w)

    def times(self, M: Floats) -> Sizes:
        """Return the sizes in other coordinates, by a matrix (w, w)."""
        return Sizes(M @ self.mean, M @ self.covariance @ M.T)

    def first(self, count: int) -> Sizes:
        """Return the first of the sizes."""
        return Sizes(self.mean[:count], self.covariance[:count, :count])


class Mistake(NamedTuple):
    """Something in the session that may be wrong."""

    name: str  # unique
    what: str  # in words
    log_odds: float  # for it, by the frames so far
    log_harm: float  # log probability that it puts this pose outside its ellipsoid
    lasting: Sizes | None = None  # of a sensor since some frame; about the world's origin


NOTHING = Mistake("", "", 0.0, -math.inf)
"""What is known of a mistake before any frame."""


def odds_of_mistakes(mistakes: Sequence[Mistake], likely: Sequence[float]) -> list[float]:
    """Return the log odds of each mistake against the pose; a session has at most one of a kind.

    `likely` has their prior probabilities.  A mistake that leaves the pose in place supports it.
    """
    joint = [math.log(p) + mistake.log_odds for p, mistake in zip(likely, mistakes, strict=True)]
    right = dict[str, float]()
    for odds, mistake in zip(joint, mistakes, strict=True):
        harmless = odds + math.log(max(-math.expm1(mistake.log_harm), 1e-300))
        right[mistake.what] = float(np.logaddexp(right.get(mistake.what, 0.0), harmless))
    return [odds + mistake.log_harm - right[mistake.what] for odds, mistake in zip(joint, mistakes)]


def possible_mistakes(
    pose: ScoredPose,
    body: Body,
    free: Mask,
    model: NoiseModel,
    sensors: Mapping[str, Sensor],
    before: Mapping[str, Mistake],
) -> Iterator[Mistake]:
    """Yield mistakes that frames make likelier than they were before any frame.

    `sensors` are by name, without motion; `before` are those of the frames before by name.
    """
    matches, (chosen,) = pose.used, free.nonzero()
    # one sensor shows neither where it stands nor how large a body is
    if not len(chosen) or (len(matches.names) < 2 and not before):
        return
    names = _names_of(matches)
    for name in before.keys() - {*names}:
        yield before[name]._replace(log_harm=-math.inf)
    noise = pose.variances[:, None]
    shares = matches.shares * matches.coordinate_weight[:, None] * noise / (noise + matches.extra)
    is_off = model.errors.are_off(matches, noise + matches.extra)
    # features far off in one sensor alone tell where sensors stand, and nothing of bodies or lenses
    is_alone = is_off & (is_off.sum(axis=0) < 2)
    if not np.count_nonzero(is_alone):
        yield from _mistakes(pose, body, chosen, model, sensors, before, names, shares)
        return
    followed = np.where(is_alone, 0.0, shares)
    for chosen_names, counted in ((names[1:-1], shares), ([SIZE, LENS], followed)):
        yield from _mistakes(pose, body, chosen, model, sensors, before, chosen_names, counted)


def _mistakes(
    pose: ScoredPose,
    body: Body,
    chosen: Indices,  # directions that are free
    model: NoiseModel,
    sensors: Mapping[str, Sensor],
    before: Mapping[str, Mistake],
    asked: Sequence[str],  # names of mistakes
    shares: Floats,  # (L, N) weights of features
) -> Iterator[Mistake]:
    """Yield the mistakes asked for that are likely by residuals with these weights."""
    matches, names = pose.used, _names_of(pose.used)
    roots, met = np.sqrt(shares).ravel().repeat(2)[:, None], shares.sum(axis=1)
    residuals, rows = roots[:, 0] * matches.offsets.ravel(), roots * matches.J.reshape(-1, 6)
    J = rows[:, chosen]
    to_pose = inverted(J.T @ J) @ J.T
    r = residuals - J @ (to_pose @ residuals)
    # noise from a hundredth of σ_ε to twice that
    s2 = np.asarray(1e-4 * 1.6 ** np.arange(24))
    noise = r, float(met @ matches.dimensions) - len(chosen), s2
    deviations = _deviations(pose, rows, met, model)
    lenses = roots * _by_lenses(pose, body, model, sensors)
    columns = _widened(_columns(pose, body, rows, deviations, model), lenses)
    stated = _stated(pose, body, roots, rows)
    remaining, stated = columns - J @ (to_pose @ columns), stated - J @ (to_pose @ stated)
    numbers = [k for k, name in enumerate(names) if name in asked]
    columns_of_asked = remaining[[0, *(k + 1 for k in numbers)]]
    log_usual, *mistaken = evidence_of(_joined(columns_of_asked, stated), *noise)[0].tolist()
    # a mistake that is not likelier by itself is not likelier together with fields
    likelier = [
        k
        for k, log in zip(numbers, mistaken, strict=True)
        if log + (known := before.get(names[k], NOTHING)).log_odds > log_usual or known.lasting
    ]
    if not likelier:
        return
    fields = _fields(matches, shares, columns[1, :, :1])
    fields = fields - J @ (to_pose @ fields)
    usual = _joined(_usual(fields, remaining[-1, :, : lenses.shape[1]], model), stated)
    logs_usual = evidence_of(usual, *noise)[0]
    inverse = inverted(pose.covariance[np.ix_(chosen, chosen)])
    # the pose if sensors weigh by their own noise, which matters if only one of them is wrong: one
    # that the pose does not follow leaves it in place
    exact = np.repeat(pose.variances.min() / pose.variances, 2 * shares.shape[1])[:, None] * J
    pulled = inverted(exact.T @ J) @ exact.T
    shift, moves = pulled @ residuals, to_pose @ columns
    moves[2:-1] = pulled @ columns[2:-1]
    for k in likelier:
        known, is_sensor = before.get(names[k], NOTHING), names[k] not in (SIZE, LENS)
        # a sensor that stands otherwise absorbs the usual errors of its lens
        layers = slice(len(usual) // 2 if is_sensor else None)
        X, explained = remaining[k + 1], usual[layers]
        log_mistaken, sizes = _fitted(X, explained, noise)
        log_mistaken, lasting = log_mistaken + max(known.log_odds, 0.0), None
        if is_sensor:
            to_origin = twists_at(-pose.T_world_object[:3, 3]) * deviations[k - 1]
            alone = log_mistaken, sizes.first(6)
            log_mistaken, sizes = _lasting(X[:, :6], explained, noise, known, to_origin, alone)
            if log_mistaken > alone[0] or pose.residual_ratio > 1:
                lasting = sizes.times(to_origin)
        moved = moves[k + 1][:, : len(sizes.mean)]
        off = is_sensor * shift - moved @ sizes.mean
        by_mistake = moved @ sizes.covariance @ moved.T + np.outer(off, off)
        outside = _outside(float(np.vdot(inverse, by_mistake)), len(chosen), 1 - model.by_chance)
        log_odds = log_mistaken - float(np.logaddexp.reduce(logs_usual[layers]))
        what = APART if is_sensor else names[k]
        yield Mistake(names[k], what, log_odds, outside[is_sensor], lasting)


def _lasting(
    X: Floats,
    usual: Floats,
    noise: Noise,
    known: Mistake,
    to_origin: Floats,  # (6, 6): from sizes to a twist about the world's origin
    alone: tuple[float, Sizes],
) -> tuple[float, Sizes]:
    """Return `alone`, or evidence and sizes of a sensor that stays as frames before tell it."""
    if known.lasting is None:
        return alone
    prior = known.lasting.times(np.asarray(np.linalg.inv(to_origin)))
    log_mistaken, sizes = _fitted(X, usual, noise, prior)
    return max(alone, (known.log_odds + log_mistaken, sizes), key=lambda pair: pair[0])


def _fitted(
    X: Floats, usual: Floats, noise: Noise, prior: Sizes | None = None
) -> tuple[float, Sizes]:
    """Return the log evidence of a mistake (R, w) beside usual errors (K, R, p), and its sizes.

    The prior of its sizes has deviations of 1 if left out.
    """
    r, degrees, s2 = noise
    width = X.shape[1]
    known, root = np.zeros(width), np.eye(width)
    if prior is not None:
        values, axes = np.linalg.eigh(prior.covariance)
        known, root = prior.mean, axes * np.sqrt(np.maximum(values, 0.0))
    logs, means, spreads = evidence_of(_joined(usual, X @ root), r - X @ known, degrees, s2)
    best = logs.argmax()
    more = Sizes(means[best, -width:], spreads[best, -width:, -width:]).times(root)
    return float(np.logaddexp.reduce(logs)), Sizes(known + more.mean, more.covariance)


def _names_of(matches: Matches) -> list[str]:
    """Return the names of mistakes in the order of `_columns`: a size, all sensors, and lenses."""
    if matches.owners is None:
        return [SIZE, *matches.names, LENS]
    firsts = np.unique(matches.owner, return_index=True)[1].tolist()
    return [SIZE, *[matches.names[k] for k in firsts], LENS]


def _outside(squared: float, directions: int, chance: float) -> tuple[float, float]:
    """Return the log probability, beyond `chance`, of a pose outside its ellipsoid; and 0 or −∞.

    The ellipsoid holds all but `chance`.  `squared` adds to the expected squared error; the second
    value is 0 if that is outside.
    """
    limit = float(chdtri(directions, chance))
    often = float(chdtrc(directions, limit / (1 + squared / directions))) - chance
    is_likely = squared > limit - directions
    return math.log(max(often, 1e-300)), 0.0 if is_likely else -math.inf


def _deviations(pose: ScoredPose, rows: Floats, met: Floats, model: NoiseModel) -> Floats:
    """Return prior deviations (S, 6) of the twist of the body as each moved sensor sees it."""
    used, by_sensor = pose.used, rows.reshape(len(met), -1, 2, 6)
    S = len(used.images)
    squares = used.summed(np.square(by_sensor[..., :3]).sum(axis=(1, 2, 3)))
    moved = np.sqrt(squares / np.maximum(used.summed(met), 1e-9))
    deviations = np.full((S, 6), model.turned)
    deviations[:, :3] = (model.shifted / np.maximum(moved, 1e-9))[:, None]
    return deviations


def _columns(
    pose: ScoredPose, body: Body, rows: Floats, deviations: Floats, model: NoiseModel
) -> Floats:
    """Return how residuals change with mistakes (S + 2, R, 6), weighted as rows (R, 6).

    Times their deviations: of none; of the body's size, in the first column; of each moved sensor.
    """
    used, T = pose.used, pose.T_world_object
    S, L = len(deviations), len(used.names)
    columns, by_sensor = np.zeros((S + 2, *rows.shape)), rows.reshape(L, -1, 2, 6)
    away = (body.nodes.points @ T[:3, :3].T)[..., None]
    columns[1, :, 0] = model.turned * (by_sensor[..., :3] @ away).ravel()
    if S > 1:  # a single sensor does not show where it stands
        by_twist = rows.reshape(L, -1, 6) * deviations[used.owner][:, None]
        columns[2:].reshape(S, L, -1, 6)[used.owner, range(L)] = by_twist
    return columns


def _by_lenses(
    pose: ScoredPose, body: Body, model: NoiseModel, sensors: Mapping[str, Sensor]
) -> Floats:
    """Return how residuals change with the distortion of each lens (R, L), times its deviation."""
    matches, points = pose.used, transform(pose.T_world_object, body.nodes.points)
    shifts = np.zeros(matches.offsets.shape)
    if sensors:
        shifts = lens_shifts(tuple([sensors[name] for name in matches.names]), model.lens, points)
    shifts *= (matches.weights > 0)[..., None] / matches.sigmas[:, None, None]
    L = len(shifts)
    columns = np.zeros((*shifts.shape, L))
    columns[range(L), ..., range(L)] = shifts
    return columns.reshape(-1, L)


def _widened(columns: Floats, more: Floats) -> Floats:
    """Append a mistake (R, q) to K mistakes (K, R, 6): (K + 1, R, p), filled up with zeros."""
    K, R, width = columns.shape
    widened = np.zeros((K + 1, R, max(width, more.shape[1])))
    widened[:-1, :, :width], widened[-1, :, : more.shape[1]] = columns, more
    return widened


def _stated(pose: ScoredPose, body: Body, roots: Floats, rows: Floats) -> Floats:
    """Return columns (R, Q) of stated errors: of calibrations, and of the body's features."""
    by_calibration, columns = pose.used.by_calibration, [np.zeros((len(rows), 0))]
    if by_calibration is not None:
        columns.append(roots * by_calibration.reshape(len(rows), -1))
    if body.spread:
        values, axes = np.linalg.eigh(body.node_spreads(pose.T_world_object))
        axes *= np.sqrt(np.maximum(values, 0.0))[:, None]
        by_feature = rows.reshape(-1, len(values), 2, 6)[..., :3] @ axes
        same = np.eye(len(values))[:, None, :, None]
        columns.append((by_feature[:, :, :, None] * same).reshape(len(rows), -1))
    return np.hstack(columns)


def _fields(matches: Matches, shares: Floats, size: Floats) -> Floats:
    """Return the usual fields (R, q), of 1 σ_ε: of sensors, and the size by errors of markers."""
    L = len(shares)
    size = size * math.sqrt(L / max(float(np.vdot(size, size)), 1e-9))
    return np.hstack([fields_of_sensors(matches, shares), size])


def _usual(fields: Floats, lenses: Floats, model: NoiseModel) -> Floats:
    """Return columns (8, R, q + L) of usual errors of sensors and markers, as a pose leaves them.

    Lenses are exact, or off by a tenth of the error of another lens.
    """
    sizes = np.reshape([0.0, model.bias / 4, model.bias, 2 * model.bias], (-1, 1, 1))
    return np.concatenate([_joined(sizes * fields, share * lenses) for share in (0.0, 0.1)])


def _joined(X: Floats, others: Floats) -> Floats:
    """Append columns (R, q) to each of K sets (K, R, p)."""
    K, R, p = X.shape
    both = np.empty((K, R, p + others.shape[-1]))
    both[..., :p], both[..., p:] = X, others
    return both


def evidence_of(X: Floats, r: Floats, degrees: float, s2: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log evidence (K,) of columns X (K, R, p), and means and covariances of their sizes.

    Sizes have a prior deviation of 1, residuals r (R,) so many degrees of freedom, noise any of s2.
    """
    values, U = np.linalg.eigh(X.swapaxes(1, 2) @ X)
    z = ((r @ X)[:, None] @ U)[:, 0, :, None]
    wide = np.maximum(values, 0.0)[..., None] + s2
    unexplained = r @ r - (z**2 / wide).sum(axis=1)
    logs = -0.5 * (degrees * np.log(s2) + unexplained / s2 + np.log(wide / s2).sum(axis=1))
    k = np.arange(len(X))[:, None], np.arange(U.shape[2]), logs.argmax(axis=1)[:, None]
    mean, S = (U * (z[..., 0] / wide[k])[:, None]).sum(axis=2), U * (s2[k[2]] / wide[k])[:, None]
    return np.logaddexp.reduce(logs, axis=1), mean, S @ U.swapaxes(1, 2)

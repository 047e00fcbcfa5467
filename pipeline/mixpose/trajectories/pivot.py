"""The tip of a tool, from poses while the tip stays at one point.

At each time the tip p in the body and the point c in the reference are at one place,

    t_k + R_k p = t'_k + R'_k c

with R', t' the pose of a reference body, or the identity where c is fixed in the world.  This is
linear in p and c (Z. Yaniv, *Which Pivot Calibration?*, SPIE Medical Imaging 2015), which is where
to begin; but its coefficients are rotations that err.  So p, c and the poses at which all of this
holds exactly are sought together: those from which the measured poses are off least, by their
covariances (F. R. Helmert, 1872; the Gauss-Helmert model).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, fdtri

from mixpose import rigid
from mixpose.constants import constant
from mixpose.errors import RecordingError
from mixpose.records import Floats, Mask
from mixpose.trajectories.motion import across_by


@dataclass(frozen=True)
class PivotRules:
    """What a tip goes by."""

    fewest: int = constant(10, "poses: six numbers are sought, three equations come of each")
    turned: float = constant(
        1.5, "times what errors alone swing a direction by: of ten poses they reach 1.45 by 0.1 %"
    )
    steps: int = constant(20, "to the likeliest tip and poses: 4 do where turns err by 1 deg")
    drawn: int = constant(100, "triples to begin with: 3 of 10 poses wrong, one in 3 has none")
    foreign: float = constant(1e-6, "chance of a pose as far off: it is left out")
    parts: int = constant(5, "of the recording that are held out in turn")
    accident: float = constant(
        0.4, "chance of parts that disagree as much: errors last; at 0.2 some that do are missed"
    )
    uneven: float = constant(
        3.0, "ratio of deviations from which a direction is said to lack turns"
    )


class Pivoting(NamedTuple):
    """Poses of a body whose tip stays where it is."""

    poses: Floats  # (N, 4, 4): of the body
    covariances: Floats  # (N, 6, 6)
    references: Floats  # (N, 4, 4): of the body that the point is fixed in; identities: the world
    reference_covariances: Floats  # (N, 6, 6)

    def part(self, some: Mask) -> Pivoting:
        """Some of the poses."""
        return Pivoting(*(each[some] for each in self))


@dataclass(frozen=True)
class Tip:
    """A tip."""

    place: Floats  # (3,): in the coordinates of the body
    covariance: Floats  # (3, 3)
    pivot: Floats  # (3,): the point that it stays at, in the world or in the reference body
    residual: float  # root mean square distance of tip and point
    expected: float  # the same by the covariances of the poses
    held_out: float  # and of poses that were held out
    scale: float  # squared residuals by covariances; above 1 it is in the covariance of the tip
    lasting: float  # variance by parts held out, against that by residuals; above 1: errors last
    frames: int  # poses that count
    left_out: int  # those that lie too far off
    turns_deg: Floats  # (3,): root mean square turns across the three directions, least first
    directions: Floats  # (3, 3): of the body, a row each


def find_tip(pivoting: Pivoting) -> Tip:
    """Find the tip of a body that turns about it.

    Raises a RecordingError if there are too few poses, or says which turns are missing.
    """
    rules = PivotRules()
    if len(pivoting.poses) < rules.fewest:
        raise RecordingError(
            f"found {len(pivoting.poses)} poses that are ok; allowed: at least {rules.fewest}, in "
            "which the tool turns about its tip"
        )
    _require_turns(pivoting, 1.0, rules)
    kept = _alike(pivoting, rules)
    for turn in range(10):
        x, information, squared = _solved(pivoting, kept, rules)
        # of three numbers, the median of χ² is 2.37; a slipping tip makes all of them larger
        usual = max(1.0, float(np.median(squared[kept])) / 2.366)
        now = squared <= usual * chdtri(3, rules.foreign)
        now &= kept | (turn < 5)  # one that is on the edge comes and goes
        if (now == kept).all() or now.sum() < rules.fewest:
            break
        kept = now
    some = pivoting.part(kept)
    rest, by_poses, _ = _at_tip(some, x, np.zeros((len(some.poses), 12)))
    expected = _covariances(some, by_poses)
    scale = float(squared[kept].sum() / (3 * len(rest) - 6))
    told = max(1.0, scale)
    # of those that count: what a wrong pose turns by tells nothing
    turns, directions = _require_turns(some, told, rules)
    covariance = told * _of_tip(information[kept])
    held_out, lasting, by_few = _held_out(some, x[:3], information[kept], told, rules)
    return Tip(
        place=x[:3],
        covariance=covariance * lasting * by_few,
        pivot=x[3:],
        residual=_rms(rest),
        expected=float(np.sqrt(np.trace(expected, axis1=1, axis2=2).mean())),
        held_out=held_out,
        scale=scale,
        lasting=lasting,
        frames=int(kept.sum()),
        left_out=int((~kept).sum()),
        turns_deg=np.degrees(turns),
        directions=directions,
    )


def _require_turns(pivoting: Pivoting, scale: float, rules: PivotRules) -> tuple[Floats, Floats]:
    """By how much directions of the body swing, RMS in radians (3,), least first; these (3, 3)."""
    R = pivoting.references[:, :3, :3].swapaxes(1, 2) @ pivoting.poses[:, :3, :3]
    away = R - R.mean(axis=0)
    values, vectors = np.linalg.eigh(np.einsum("kij,kil->jl", away, away) / len(R))
    turns, directions = np.sqrt(np.maximum(values, 0.0)), vectors.T
    both = scale * (pivoting.covariances + pivoting.reference_covariances)[:, 3:, 3:]
    d = pivoting.poses[:, :3, :3] @ directions.T
    # a turn by w moves a direction by w × d
    along = np.einsum("kin,kij,kjn->kn", d, both, d)
    noise = np.sqrt((np.trace(both, axis1=1, axis2=2)[:, None] - along).mean(axis=0))
    swings = turns > rules.turned * noise
    if swings[0]:
        return turns, directions
    least, found = np.degrees(rules.turned * noise), np.degrees(turns)
    if not swings[1]:
        raise RecordingError(
            f"the body hardly turns about one point: found {found[2]:.3g} deg RMS, of which errors "
            f"make {np.degrees(noise[2]):.2g}, {np.sqrt(scale):.3g} times what the poses say; "
            "allowed: turns of 20 deg and more about two axes, while the tip stays where it is"
        )
    axis = ", ".join(f"{value:.2f}" for value in directions[0])
    raise RecordingError(
        f"the tip is not determined along the direction ({axis}) of the body: all turns are about "
        f"it, it swings by {found[0]:.2g} deg RMS; allowed: at least {least[0]:.2g}: tilt the "
        "tool, too, so that this direction swings by 20 deg and more"
    )


def _linear(pivoting: Pivoting) -> tuple[Floats, Floats]:
    """Coefficients (N, 3, 6) of tip and point, and what they should make (N, 3)."""
    A = np.concatenate([pivoting.poses[:, :3, :3], -pivoting.references[:, :3, :3]], axis=2)
    return A, pivoting.references[:, :3, 3] - pivoting.poses[:, :3, 3]


def _alike(pivoting: Pivoting, rules: PivotRules) -> Mask:
    """The poses (N,) to begin with, by least median (P. Rousseeuw, J. Am. Stat. Assoc. 79 (1984)
    871).
    """
    (A, b), rng = _linear(pivoting), np.random.default_rng(0)
    some = rng.permuted(np.tile(np.arange(len(b)), (rules.drawn, 1)), axis=1)[:, :3]
    x = np.linalg.pinv(A[some].reshape(-1, 9, 6)) @ b[some].reshape(-1, 9, 1)
    off = np.linalg.norm(A @ x[:, None] - b[..., None], axis=(2, 3))
    medians = np.median(off, axis=1)
    # of three numbers as large by chance, the median of the length is 1.54 deviations
    gate = medians.min() / 1.54 * np.sqrt(chdtri(3, rules.foreign))
    return np.asarray(off[medians.argmin()] <= gate)


def _solved(pivoting: Pivoting, kept: Mask, rules: PivotRules) -> tuple[Floats, Floats, Floats]:
    """Tip and point (6,) by the poses that are kept; information (N, 6, 6) and χ² (N,) of each."""
    A, b = _linear(pivoting.part(kept))
    x: Floats = np.linalg.lstsq(A.reshape(-1, 6), b.ravel(), rcond=None)[0].astype(np.float64)
    steps = np.zeros((len(pivoting.poses), 12))  # from the measured poses to those that fit
    for _ in range(rules.steps):
        rest, by_poses, by_x = _at_tip(pivoting, x, steps)
        W = np.linalg.inv(_covariances(pivoting, by_poses))
        weighed = by_x.swapaxes(1, 2) @ W
        information = weighed @ by_x
        left = rest - np.einsum("kij,kj->ki", by_poses, steps)
        pull = np.einsum("kij,kj->i", weighed[kept], left[kept])
        step = -np.linalg.solve(information[kept].sum(axis=0), pull)
        left += by_x @ step
        pulls = np.einsum("kij,kj->ki", W, left)
        steps = -_spread(pivoting, np.einsum("kji,kj->ki", by_poses, pulls)[:, :, None])[..., 0]
        x = x + step
        if np.linalg.norm(step) <= 1e-12 * np.linalg.norm(x):
            break
    return x, information, np.einsum("ki,ki->k", left, pulls)


def _of_tip(information: Floats) -> Floats:
    """Covariance (3, 3) of a tip by the information (n, 6, 6) of poses."""
    return np.asarray(np.linalg.inv(information.sum(axis=0))[:3, :3])


def _at_tip(pivoting: Pivoting, x: Floats, steps: Floats) -> tuple[Floats, Floats, Floats]:
    """From the point to the tip (N, 3) with poses moved by steps (N, 12), by steps and by x."""
    by_poses, by_x, rest = [], [], np.zeros((len(steps), 3))
    sides = ((pivoting.poses, x[:3], 1.0), (pivoting.references, x[3:], -1.0))
    for (poses, place, sign), twists in zip(sides, np.split(steps, 2, axis=1), strict=True):
        moved = rigid.perturb(poses, twists)
        arms = moved[:, :3, :3] @ place
        rest += sign * (arms + moved[:, :3, 3])
        # a turn moves an arm across both; on top of another one, by the left Jacobian of SO(3)
        by_turn = -across_by(arms) @ rigid.rotation_matrix(twists[:, 3:] / 2)  # to 2nd order
        J = np.concatenate([np.broadcast_to(np.eye(3), by_turn.shape), by_turn], axis=2)
        by_poses.append(sign * J)
        by_x.append(sign * moved[:, :3, :3])
    return rest, np.concatenate(by_poses, axis=2), np.concatenate(by_x, axis=2)


def _spread(pivoting: Pivoting, columns: Floats) -> Floats:
    """Covariances of both poses times columns (N, 12, n)."""
    own, other = pivoting.covariances, pivoting.reference_covariances
    return np.concatenate([own @ columns[:, :6], other @ columns[:, 6:]], axis=1)


def _covariances(pivoting: Pivoting, by_poses: Floats) -> Floats:
    """Of the distances from point to tip (N, 3, 3), with Jacobians (N, 3, 12) by the poses."""
    both = by_poses @ _spread(pivoting, by_poses.swapaxes(1, 2))
    # directions that are held err by nothing, and nothing can be weighed by that
    least = 1e-9 * np.trace(both, axis1=1, axis2=2).mean() + 1e-300
    return np.asarray(both + least * np.eye(3))


def _held_out(
    some: Pivoting, tip: Floats, information: Floats, scale: float, rules: PivotRules
) -> tuple[float, float, float]:
    """RMS residual of parts of the recording by tips found without them; factors of variance."""
    rest, squared = [], 0.0
    for part in np.array_split(np.arange(len(some.poses)), rules.parts):
        others = np.ones(len(some.poses), bool)
        others[part] = False
        x, *_ = _solved(some, others, rules)
        rest.append(_at_tip(some, x, np.zeros((len(some.poses), 12)))[0][part])
        away = x[:3] - tip
        # of nested least squares the covariance of a difference is that of covariances
        differing = scale * (_of_tip(information[others]) - _of_tip(information))
        squared += float(away @ np.linalg.pinv(differing) @ away)
    # all of them differ from their own mean; two of n have n - 2 parts in common
    freedom = 3 * (rules.parts - 1)
    squared *= (rules.parts - 1) / rules.parts
    held_out = _rms(np.concatenate(rest))
    if squared <= chdtri(freedom, rules.accident):
        return held_out, 1.0, 1.0
    # where few numbers tell its size, an ellipsoid of 95 % is larger: R. A. Fisher's F, not χ²
    return held_out, squared / freedom, float(3 * fdtri(3, freedom, 0.95) / chdtri(3, 0.05))


def _rms(rest: Floats) -> float:
    return float(np.sqrt((rest**2).sum(axis=1).mean()))


def fixed_in_world(poses: Floats, covariances: Floats) -> Pivoting:
    """Poses of a body whose tip stays at a point of the world."""
    references = np.broadcast_to(np.eye(4), poses.shape)
    return Pivoting(poses, covariances, references, np.zeros_like(covariances))


def fixed_in(pivoting: Pivoting, references: Floats, covariances: Floats) -> Pivoting:
    """The same, of which the point is fixed in another body with these poses."""
    return pivoting._replace(references=references, reference_covariances=covariances)

"""Find the tip of a tool from poses while the tip stays at a point.

At all times the tip p of the body and the point c of the reference coincide,

    t_k + R_k p = t'_k + R'_k c

with R', t' the pose of a reference body, or the identity if c is fixed in the world.  This is
linear in p and c (Z. Yaniv, *Which Pivot Calibration?*, SPIE Medical Imaging 2015), which gives the
start; but its coefficients are rotations with errors.  So p, c and poses that fulfil all equations
exactly are fitted together: those from which the measured poses deviate least, by their
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
    """Rules for finding a tip."""

    fewest: int = constant(10, "poses: six unknowns, three equations per pose")
    turned: float = constant(
        1.5, "times the swing by errors alone, which for ten poses reaches 1.45 in 0.1 % of cases"
    )
    steps: int = constant(20, "to the likeliest tip and poses: 4 suffice if turns are off by 1 deg")
    drawn: int = constant(100, "triples for the start: with 3 of 10 poses wrong, one in 3 has none")
    foreign: float = constant(1e-6, "chance of a pose as far off that is then left out")
    parts: int = constant(5, "of the recording, held out in turn")
    accident: float = constant(
        0.4, "chance of parts that disagree as much, for persistent errors; 0.2 misses some"
    )
    uneven: float = constant(
        3.0, "ratio of deviations from which turns are reported to lack in a direction"
    )


class Pivoting(NamedTuple):
    """Poses of a body while its tip stays at a point."""

    poses: Floats  # (N, 4, 4): of the body
    covariances: Floats  # (N, 6, 6)
    references: Floats  # (N, 4, 4): of the body in which the point is fixed; identities: the world
    reference_covariances: Floats  # (N, 6, 6)

    def part(self, selected: Mask) -> Pivoting:
        """Return the selected poses."""
        return Pivoting(*(field[selected] for field in self))


@dataclass(frozen=True)
class Tip:
    """The tip of a body, and how well it is known."""

    place: Floats  # (3,): in object coordinates
    covariance: Floats  # (3, 3)
    pivot: Floats  # (3,): the point where it stays, in the world or in the reference body
    residual: float  # root mean square distance of tip and point
    expected: float  # residual expected by the covariances of the poses
    held_out: float  # residual of poses that were held out
    scale: float  # squared residuals over covariances; above 1 it scales the tip's covariance
    held_out_ratio: float  # variance by held-out parts over that by residuals; > 1: errors persist
    frames: int  # number of poses used
    left_out: int  # number of poses too far off
    turns_deg: Floats  # (3,): root mean square swings of the three directions, least first
    directions: Floats  # (3, 3): of the body, in rows


def find_tip(pivoting: Pivoting) -> Tip:
    """Find the tip of a body that turns about it.

    Raises RecordingError if there are too few poses, or turns about some axis are missing.
    """
    rules = PivotRules()
    if len(pivoting.poses) < rules.fewest:
        raise RecordingError(
            f"found {len(pivoting.poses)} poses that are ok; allowed: at least {rules.fewest}, in "
            "which the tool turns about its tip"
        )
    _require_turns(pivoting, 1.0, rules)
    kept = _start_poses(pivoting, rules)
    for iteration in range(10):
        x, information, squared = _fitted(pivoting, kept, rules)
        # the median of χ² of three degrees is 2.37; a slipping tip enlarges all distances
        typical = max(1.0, float(np.median(squared[kept])) / 2.366)
        inliers = squared <= typical * chdtri(3, rules.foreign)
        inliers &= kept | (iteration < 5)  # later none returns, as it might come and go
        if (inliers == kept).all() or inliers.sum() < rules.fewest:
            break
        kept = inliers
    inlying = pivoting.part(kept)
    offsets, by_poses, _ = _tip_offsets(inlying, x, np.zeros((len(inlying.poses), 12)))
    expected = _covariances(inlying, by_poses)
    scale = float(squared[kept].sum() / (3 * len(offsets) - 6))
    factor = max(1.0, scale)
    # turns of the inlying poses alone, as those of wrong poses mean nothing
    turns, directions = _require_turns(inlying, factor, rules)
    covariance = factor * _tip_covariance(information[kept])
    held_out, ratio, enlarged = _cross_validated(inlying, x[:3], information[kept], factor, rules)
    return Tip(
        place=x[:3],
        covariance=covariance * ratio * enlarged,
        pivot=x[3:],
        residual=_rms(offsets),
        expected=float(np.sqrt(np.trace(expected, axis1=1, axis2=2).mean())),
        held_out=held_out,
        scale=scale,
        held_out_ratio=ratio,
        frames=int(kept.sum()),
        left_out=int((~kept).sum()),
        turns_deg=np.degrees(turns),
        directions=directions,
    )


def _require_turns(pivoting: Pivoting, scale: float, rules: PivotRules) -> tuple[Floats, Floats]:
    """Return RMS swings (3,) of directions of the body, radians, least first, and these (3, 3)."""
    R = pivoting.references[:, :3, :3].swapaxes(1, 2) @ pivoting.poses[:, :3, :3]
    deviations = R - R.mean(axis=0)
    values, vectors = np.linalg.eigh(np.einsum("kij,kil->jl", deviations, deviations) / len(R))
    turns, directions = np.sqrt(np.maximum(values, 0.0)), vectors.T
    C = scale * (pivoting.covariances + pivoting.reference_covariances)[:, 3:, 3:]
    d = pivoting.poses[:, :3, :3] @ directions.T
    # a small rotation w moves a direction d by w × d
    along = np.einsum("kin,kij,kjn->kn", d, C, d)
    noise = np.sqrt((np.trace(C, axis1=1, axis2=2)[:, None] - along).mean(axis=0))
    swings = turns > rules.turned * noise
    if swings[0]:
        return turns, directions
    least, swung = np.degrees(rules.turned * noise), np.degrees(turns)
    if not swings[1]:
        raise RecordingError(
            f"the body hardly turns about one point: found {swung[2]:.3g} deg RMS, of which errors "
            f"make {np.degrees(noise[2]):.2g}, {np.sqrt(scale):.3g} times what the poses say; "
            "allowed: turns of 20 deg and more about two axes, while the tip stays where it is"
        )
    axis = ", ".join(f"{value:.2f}" for value in directions[0])
    raise RecordingError(
        f"the tip is not determined along the direction ({axis}) of the body: all turns are about "
        f"it, it swings by {swung[0]:.2g} deg RMS; allowed: at least {least[0]:.2g}: tilt the "
        "tool, too, so that this direction swings by 20 deg and more"
    )


def _linear(pivoting: Pivoting) -> tuple[Floats, Floats]:
    """Return coefficients (N, 3, 6) of tip and point, and right-hand sides (N, 3)."""
    A = np.concatenate([pivoting.poses[:, :3, :3], -pivoting.references[:, :3, :3]], axis=2)
    return A, pivoting.references[:, :3, 3] - pivoting.poses[:, :3, 3]


def _start_poses(pivoting: Pivoting, rules: PivotRules) -> Mask:
    """Select poses (N,) for the start, by the least median (P. Rousseeuw, J. Am. Stat. Assoc. 79
    (1984) 871).
    """
    (A, b), rng = _linear(pivoting), np.random.default_rng(0)
    triples = rng.permuted(np.tile(np.arange(len(b)), (rules.drawn, 1)), axis=1)[:, :3]
    x = np.linalg.pinv(A[triples].reshape(-1, 9, 6)) @ b[triples].reshape(-1, 9, 1)
    distances = np.linalg.norm(A @ x[:, None] - b[..., None], axis=(2, 3))
    medians = np.median(distances, axis=1)
    # the median length of three normal numbers is 1.54 deviations
    gate = medians.min() / 1.54 * np.sqrt(chdtri(3, rules.foreign))
    return np.asarray(distances[medians.argmin()] <= gate)


def _fitted(pivoting: Pivoting, kept: Mask, rules: PivotRules) -> tuple[Floats, Floats, Floats]:
    """Fit tip and point (6,) to the kept poses; also return information (N, 6, 6) and χ² (N,)."""
    A, b = _linear(pivoting.part(kept))
    x: Floats = np.linalg.lstsq(A.reshape(-1, 6), b.ravel(), rcond=None)[0].astype(np.float64)
    steps = np.zeros((len(pivoting.poses), 12))  # from the measured poses to the fitted ones
    for _ in range(rules.steps):
        offsets, by_poses, by_x = _tip_offsets(pivoting, x, steps)
        W = np.linalg.inv(_covariances(pivoting, by_poses))
        weighed = by_x.swapaxes(1, 2) @ W
        information = weighed @ by_x
        residuals = offsets - np.einsum("kij,kj->ki", by_poses, steps)
        gradient = np.einsum("kij,kj->i", weighed[kept], residuals[kept])
        step = -np.linalg.solve(information[kept].sum(axis=0), gradient)
        residuals += by_x @ step
        pulls = np.einsum("kij,kj->ki", W, residuals)
        steps = -_multiplied(pivoting, np.einsum("kji,kj->ki", by_poses, pulls)[:, :, None])[..., 0]
        x = x + step
        if np.linalg.norm(step) <= 1e-12 * np.linalg.norm(x):
            break
    return x, information, np.einsum("ki,ki->k", residuals, pulls)


def _tip_covariance(information: Floats) -> Floats:
    """Return the covariance (3, 3) of a tip by the information (n, 6, 6) of poses."""
    return np.asarray(np.linalg.inv(information.sum(axis=0))[:3, :3])


def _tip_offsets(pivoting: Pivoting, x: Floats, steps: Floats) -> tuple[Floats, Floats, Floats]:
    """Return offsets (N, 3) of tips at poses moved by steps (N, 12); Jacobians by steps and x."""
    by_poses, by_x, offsets = [], [], np.zeros((len(steps), 3))
    sides = ((pivoting.poses, x[:3], 1.0), (pivoting.references, x[3:], -1.0))
    for (poses, place, sign), twists in zip(sides, np.split(steps, 2, axis=1), strict=True):
        moved = rigid.perturb(poses, twists)
        arms = moved[:, :3, :3] @ place
        offsets += sign * (arms + moved[:, :3, 3])
        # derivative by a rotation on top of another: the left Jacobian of SO(3)
        by_turn = -across_by(arms) @ rigid.rotation_matrix(twists[:, 3:] / 2)  # to 2nd order
        J = np.concatenate([np.broadcast_to(np.eye(3), by_turn.shape), by_turn], axis=2)
        by_poses.append(sign * J)
        by_x.append(sign * moved[:, :3, :3])
    return offsets, np.concatenate(by_poses, axis=2), np.concatenate(by_x, axis=2)


def _multiplied(pivoting: Pivoting, columns: Floats) -> Floats:
    """Multiply the covariances of both poses by columns (N, 12, n)."""
    C, C_reference = pivoting.covariances, pivoting.reference_covariances
    return np.concatenate([C @ columns[:, :6], C_reference @ columns[:, 6:]], axis=1)


def _covariances(pivoting: Pivoting, by_poses: Floats) -> Floats:
    """Return covariances (N, 3, 3) of offsets from point to tip, by Jacobians (N, 3, 12)."""
    C = by_poses @ _multiplied(pivoting, by_poses.swapaxes(1, 2))
    # held directions have no variance, which has no inverse
    least = 1e-9 * np.trace(C, axis1=1, axis2=2).mean() + 1e-300
    return np.asarray(C + least * np.eye(3))


def _cross_validated(
    pivoting: Pivoting, tip: Floats, information: Floats, scale: float, rules: PivotRules
) -> tuple[float, float, float]:
    """Return the RMS residual of held-out parts by tips of the others, and two variance factors."""
    offsets, squared = [], 0.0
    for part in np.array_split(np.arange(len(pivoting.poses)), rules.parts):
        is_used = np.ones(len(pivoting.poses), bool)
        is_used[part] = False
        x, *_ = _fitted(pivoting, is_used, rules)
        offsets.append(_tip_offsets(pivoting, x, np.zeros((len(pivoting.poses), 12)))[0][part])
        away = x[:3] - tip
        # in nested least squares the covariance of a difference is the difference of covariances
        differing = scale * (_tip_covariance(information[is_used]) - _tip_covariance(information))
        squared += float(away @ np.linalg.pinv(differing) @ away)
    # tips deviate from their mean; any two of n fits share n - 2 parts
    freedom = 3 * (rules.parts - 1)
    squared *= (rules.parts - 1) / rules.parts
    held_out = _rms(np.concatenate(offsets))
    if squared <= chdtri(freedom, rules.accident):
        return held_out, 1.0, 1.0
    # with a variance from few numbers an ellipsoid of 95 % is larger: R. A. Fisher's F, not χ²
    return held_out, squared / freedom, float(3 * fdtri(3, freedom, 0.95) / chdtri(3, 0.05))


def _rms(offsets: Floats) -> float:
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


def fixed_in_world(poses: Floats, covariances: Floats) -> Pivoting:
    """Return poses of a body whose tip stays at a point of the world."""
    references = np.broadcast_to(np.eye(4), poses.shape)
    return Pivoting(poses, covariances, references, np.zeros_like(covariances))


def fixed_in(pivoting: Pivoting, references: Floats, covariances: Floats) -> Pivoting:
    """Return poses of a body whose tip stays at a point of another body with these poses."""
    return pivoting._replace(references=references, reference_covariances=covariances)

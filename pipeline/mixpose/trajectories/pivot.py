"""The tip of a tool, from poses while the tip stays at one point.

At each time the tip p in the body and the point c in the reference are at one place,

    t_k + R_k p = t'_k + R'_k c

with R', t' the pose of a reference body, or the identity where c is fixed in the world.  This is
linear in p and c (Z. Yaniv, *Which Pivot Calibration?*, SPIE Medical Imaging 2015); then each
equation is weighed by the covariance of its poses at the tip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mixpose import rigid
from mixpose.constants import constant
from mixpose.errors import RecordingError
from mixpose.records import Floats, Mask


@dataclass(frozen=True)
class PivotRules:
    """What a tip goes by."""

    fewest: int = constant(10, "poses: six numbers are sought, three equations come of each")
    turned: float = constant(
        5.0, "times the noise of turns: of less, noise passes for turning, by 4 % (1/5²)"
    )
    steps: int = constant(20, "of weighing: weights change with the place of the tip; 4 are enough")
    foreign: float = constant(1e-6, "chance of a pose as far off: it is left out")
    parts: int = constant(5, "of the recording that are held out in turn")
    accident: float = constant(
        1e-3, "chance of parts that disagree as much: errors last, and more poses tell no more"
    )
    uneven: float = constant(
        3.0, "ratio of deviations from which a direction is said to lack turns"
    )


class Pivoting(NamedTuple):
    """Poses of a body whose tip stays where it is."""

    poses: Floats  # (N, 4, 4): of the body
    covariances: Floats  # (N, 6, 6)
    # (N, 4, 4): of the body that the point is fixed in; of the world these are the identity, and
    # their covariances zero
    references: Floats
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
    # squared residuals by their covariances; what is above 1 is in the covariance of the tip
    scale: float
    # variance of the tip by parts of the recording that are held out, against that by residuals;
    # above 1 where errors last, and then in the covariance, too
    lasting: float
    frames: int  # poses that count
    left_out: int  # those that lie too far off
    turns_deg: Floats  # (3,): root mean square turns across the three directions, least first
    directions: Floats  # (3, 3): of the body, a row each


def find_tip(pivoting: Pivoting, rules: PivotRules | None = None) -> Tip:
    """Find the tip of a body that turns about it.

    Raises a RecordingError if there are too few poses, or says which turns are missing.
    """
    rules = rules or PivotRules()
    if len(pivoting.poses) < rules.fewest:
        raise RecordingError(
            f"found {len(pivoting.poses)} poses that are ok; allowed: at least {rules.fewest}, in "
            "which the tool turns about its tip"
        )
    turns, directions = turns_seen(pivoting)
    _require_turns(pivoting, turns, directions, rules)
    kept = np.ones(len(pivoting.poses), bool)
    for _ in range(3):
        some = pivoting.part(kept)
        x, covariance, squared = _solved(some, pivoting, rules)
        # of three numbers, the median of χ² is 2.37; a slipping tip makes all of them larger
        usual = max(1.0, float(np.median(squared[kept])) / 2.366)
        now = squared <= usual * chdtri(3, rules.foreign)
        if (now == kept).all() or now.sum() < rules.fewest:
            break
        kept = now
    some = pivoting.part(kept)
    rest = _residuals(some, x)
    expected = _covariances(some, x)
    scale = float(squared[kept].sum() / (3 * len(rest) - 6))
    covariance = covariance[:3, :3] * max(1.0, scale)
    held_out, lasting = _held_out(some, x[:3], covariance, max(1.0, scale), rules)
    return Tip(
        place=x[:3],
        covariance=covariance * lasting,
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


def turns_seen(pivoting: Pivoting) -> tuple[Floats, Floats]:
    """By how much directions of the body swing, RMS in radians (3,), least first, and these (3, 3).

    The tip along a direction that does not swing may be anywhere.
    """
    R = pivoting.references[:, :3, :3].swapaxes(1, 2) @ pivoting.poses[:, :3, :3]
    away = R - R.mean(axis=0)
    values, vectors = np.linalg.eigh(np.einsum("kij,kil->jl", away, away) / len(R))
    return np.sqrt(np.maximum(values, 0.0)), vectors.T


def _require_turns(
    pivoting: Pivoting, turns: Floats, directions: Floats, rules: PivotRules
) -> None:
    both = pivoting.covariances + pivoting.reference_covariances
    noise = np.sqrt(2 * np.diagonal(both, axis1=1, axis2=2)[:, 3:].mean())
    if turns[0] > rules.turned * noise:
        return
    least = np.degrees(rules.turned * noise)
    found = np.degrees(turns)
    if turns[1] <= rules.turned * noise:
        raise RecordingError(
            f"the body hardly turns: found {found[2]:.3g} deg RMS; allowed: turns of 20 deg and "
            "more about two axes, while the tip stays where it is"
        )
    axis = ", ".join(f"{value:.2f}" for value in directions[0])
    raise RecordingError(
        f"the tip is not determined along the direction ({axis}) of the body: all turns are about "
        f"it, it swings by {found[0]:.2g} deg RMS; allowed: at least {least:.2g}: tilt the tool, "
        "too, so that this direction swings by 20 deg and more"
    )


def _solved(some: Pivoting, of_all: Pivoting, rules: PivotRules) -> tuple[Floats, Floats, Floats]:
    """Tip and point (6,), their covariance, and squared residuals of all poses."""
    A = np.concatenate([some.poses[:, :3, :3], -some.references[:, :3, :3]], axis=2)
    b = some.references[:, :3, 3] - some.poses[:, :3, 3]
    x = np.linalg.lstsq(A.reshape(-1, 6), b.ravel(), rcond=None)[0]
    information = np.eye(6)
    for _ in range(rules.steps):
        W = np.linalg.inv(_covariances(some, x))
        weighed = A.swapaxes(1, 2) @ W
        information = (weighed @ A).sum(axis=0)
        before, x = x, np.linalg.solve(information, np.einsum("kij,kj->i", weighed, b))
        if np.linalg.norm(x - before) <= 1e-12 * np.linalg.norm(x):
            break
    rest = _residuals(of_all, x)
    solved = np.linalg.solve(_covariances(of_all, x), rest[..., None])[..., 0]
    squared = np.einsum("ki,ki->k", rest, solved)
    return x, np.asarray(np.linalg.inv(information)), np.asarray(squared)


def _residuals(some: Pivoting, x: Floats) -> Floats:
    """From the point to the tip, (N, 3)."""
    tips = rigid.transform(some.poses, x[None, :3]) - rigid.transform(some.references, x[None, 3:])
    return np.asarray(tips[:, 0])


def _covariances(some: Pivoting, x: Floats) -> Floats:
    """Of the residuals, (N, 3, 3)."""
    tips = rigid.covariance_at(some.covariances, some.poses[:, :3, :3] @ x[:3])
    points = rigid.covariance_at(some.reference_covariances, some.references[:, :3, :3] @ x[3:])
    both = (tips + points)[:, :3, :3]
    # directions that are held err by nothing, and nothing can be weighed by that
    least = 1e-9 * np.trace(both, axis1=1, axis2=2).mean() + 1e-300
    return np.asarray(both + least * np.eye(3))


def _held_out(
    some: Pivoting, tip: Floats, covariance: Floats, scale: float, rules: PivotRules
) -> tuple[float, float]:
    """RMS residual of parts of the recording, each by a tip that was found without it.

    And the squared distance of these tips from that of all, against what it would be if errors of
    all frames were independent; 1 unless it is surely more.
    """
    rest, squared = [], 0.0
    for part in np.array_split(np.arange(len(some.poses)), rules.parts):
        others = np.ones(len(some.poses), bool)
        others[part] = False
        x, own, _ = _solved(some.part(others), some, rules)
        rest.append(_residuals(some, x)[part])
        away = x[:3] - tip
        # of nested least squares the covariance of a difference is that of covariances
        squared += float(away @ np.linalg.pinv(scale * own[:3, :3] - covariance) @ away)
    freedom = 3 * (rules.parts - 1)  # all of them differ from their own mean
    is_more = squared > chdtri(freedom, rules.accident)
    return _rms(np.concatenate(rest)), squared / freedom if is_more else 1.0


def _rms(rest: Floats) -> float:
    return float(np.sqrt((rest**2).sum(axis=1).mean()))


def fixed_in_world(poses: Floats, covariances: Floats) -> Pivoting:
    """Poses of a body whose tip stays at a point of the world."""
    references = np.broadcast_to(np.eye(4), poses.shape)
    return Pivoting(poses, covariances, references, np.zeros_like(covariances))


def fixed_in(pivoting: Pivoting, references: Floats, covariances: Floats) -> Pivoting:
    """The same, of which the point is fixed in another body with these poses."""
    return pivoting._replace(references=references, reference_covariances=covariances)

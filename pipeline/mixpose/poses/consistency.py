"""What errors say together: whether covariances are right, or one transform is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtri

from mixpose import rigid
from mixpose.records import Floats

CONFIDENCE = 0.95

_FEWEST = 5  # frames
_ZERO = 1e-9  # of a length that is written
_LEFT = 0.1  # of the errors, at most, for a constant transform to explain them


@dataclass(frozen=True)
class Consistency:
    """Whether the covariances tell the truth, over "ok" frames that have one."""

    frames: int
    mean_per_dimension: float  # mean NEES by its dimensions: above 1 if they promise too much
    inside_95: float  # share of frames whose truth lies inside the 95 % ellipsoid


def consistency(measured: Sequence[tuple[float, int]]) -> Consistency | None:
    """Of frames, each with its squared error and number of dimensions; None of none."""
    if not measured:
        return None
    nees, dimensions = np.array(measured, dtype=np.float64).T
    limits = chdtri(dimensions, 1.0 - CONFIDENCE)
    return Consistency(
        frames=len(measured),
        mean_per_dimension=float(np.mean(nees / dimensions)),
        inside_95=float(np.mean(nees <= limits)),
    )


def normalised_error_squared(twist: Floats, covariance: Floats) -> tuple[float | None, int]:
    """Mahalanobis distance squared of an error (6,), and its dimensions: the covariance's rank.

    Only directions that the covariance (6, 6) leaves free count: one that is held at the start pose
    has no variance. None where it leaves none free.
    """
    variance = np.diag(covariance)
    kind = np.repeat([variance[:3].max(), variance[3:].max()], 3)
    free = np.flatnonzero(variance > 1e-12 * kind)
    scale = np.sqrt(variance[free])
    correlation = covariance[np.ix_(free, free)] / scale[:, None] / scale
    values, vectors = np.linalg.eigh(correlation)
    kept = values > 1e-9
    along = vectors.T @ (twist[free] / scale)
    dimensions = int(kept.sum())
    if not dimensions:
        return None, 0
    return float(np.sum(along[kept] ** 2 / values[kept])), dimensions


@dataclass(frozen=True)
class ConstantOffset:
    """A transform that takes all poses near to the truth."""

    of: Literal["object", "world"]  # right of the poses, ``T_truth = T_pose T``, or left of them
    T: Floats  # (4, 4)
    rotation_deg_rms: float  # of errors that are left with it
    translation_rms: float

    def text(self, unit: str) -> str:
        """In words."""
        turn = float(rigid.rotation_angle_deg(self.T, np.eye(4)))
        moved = np.where(np.abs(self.T[:3, 3]) < _ZERO, 0.0, self.T[:3, 3])
        shift = ", ".join(f"{value:.4g}" for value in moved)
        asked = {
            "object": "has the truth another origin or other axes of the object?",
            "world": "is the truth in another frame of the world?",
        }
        return (
            f"one transform explains most of this, in the axes of the {self.of}: turned by "
            f"{turn:.4g} deg, moved by ({shift}) {unit}; with it errors are "
            f"{self.rotation_deg_rms:.4g} deg and {self.translation_rms:.4g} {unit} RMS: "
            f"{asked[self.of]}"
        )


def constant_offset(pairs: Sequence[tuple[Floats, Floats]]) -> ConstantOffset | None:
    """The transform that explains most of the errors of poses with their truths, if one does."""
    if len(pairs) < _FEWEST:
        return None
    poses, truth = (np.stack(each) for each in zip(*pairs, strict=True))
    before = _rms(poses, truth)
    moving = _rms(np.broadcast_to(truth[:1], truth.shape), truth)
    if (moving < before).all():
        return None
    of_object = rigid.mean_motion(rigid.inverse(poses) @ truth)
    of_world = rigid.mean_motion(truth @ rigid.inverse(poses))
    found = [
        ConstantOffset("object", of_object, *_rms(poses @ of_object, truth).tolist()),
        ConstantOffset("world", of_world, *_rms(of_world @ poses, truth).tolist()),
    ]
    good = []
    for each in found:  # one kind of error nearly vanishes, and the other grows no larger
        after = np.array([each.rotation_deg_rms, each.translation_rms])
        if (after < _LEFT * before).any() and (after < 1.1 * before).all():
            good.append(each)
    return min(good, key=lambda each: each.translation_rms) if good else None


def _rms(one: Floats, other: Floats) -> Floats:
    """Of angles in degrees and of distances (2,)."""
    twists = rigid.twist_between(one, other).reshape(-1, 2, 3)
    rms = np.sqrt((twists**2).sum(axis=2).mean(axis=0))[::-1]
    return np.asarray(rms * [180 / np.pi, 1.0])

"""Judge the errors of all frames: whether covariances are right, or one transform is wrong."""

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
_ZERO = 1e-9  # length that is written as 0
_REMAINING = 0.1  # largest remaining share of errors that a constant transform explains


@dataclass(frozen=True)
class Consistency:
    """Errors of "ok" frames in comparison with their covariances."""

    frames: int
    mean_per_dimension: float  # mean NEES over its dimensions: above 1 if covariances are too small
    inside_95: float  # share of frames whose truth lies inside the 95 % ellipsoid


def consistency(measured: Sequence[tuple[float, int]]) -> Consistency | None:
    """Summarise squared errors of frames, given with their dimensions; None without frames."""
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
    """Return the squared Mahalanobis distance of an error (6,), and the rank of its covariance.

    Only directions that the covariance (6, 6) leaves free count: those held at the start pose have
    no variance. The distance is None if no direction is free.
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
    """A transform that brings all poses near to the truth."""

    of: Literal["object", "world"]  # object: ``T_truth = T_pose T``; world: ``T_truth = T T_pose``
    T: Floats  # (4, 4)
    rotation_deg_rms: float  # of the errors that remain with it
    translation_rms: float

    def text(self, unit: str) -> str:
        """Describe the transform in a sentence."""
        turn = float(rigid.rotation_angle_deg(self.T, np.eye(4)))
        moved = np.where(np.abs(self.T[:3, 3]) < _ZERO, 0.0, self.T[:3, 3])
        shift = ", ".join(f"{value:.4g}" for value in moved)
        question = {
            "object": "has the truth another origin or other axes of the object?",
            "world": "is the truth in another frame of the world?",
        }
        return (
            f"one transform explains most of this, in the axes of the {self.of}: turned by "
            f"{turn:.4g} deg, moved by ({shift}) {unit}; with it errors are "
            f"{self.rotation_deg_rms:.4g} deg and {self.translation_rms:.4g} {unit} RMS: "
            f"{question[self.of]}"
        )


def constant_offset(pairs: Sequence[tuple[Floats, Floats]]) -> ConstantOffset | None:
    """Find the transform that explains most errors of (pose, truth) pairs; None if none does."""
    if len(pairs) < _FEWEST:
        return None
    poses, truth = (np.stack(column) for column in zip(*pairs, strict=True))
    before = _rms(poses, truth)
    moving = _rms(np.broadcast_to(truth[:1], truth.shape), truth)
    if (moving < before).all():
        return None
    of_object = rigid.mean_motion(rigid.inverse(poses) @ truth)
    of_world = rigid.mean_motion(truth @ rigid.inverse(poses))
    candidates = [
        ConstantOffset("object", of_object, *_rms(poses @ of_object, truth).tolist()),
        ConstantOffset("world", of_world, *_rms(of_world @ poses, truth).tolist()),
    ]
    good = []
    for offset in candidates:  # one kind of error nearly vanishes, and the other hardly grows
        after = np.array([offset.rotation_deg_rms, offset.translation_rms])
        if (after < _REMAINING * before).any() and (after < 1.1 * before).all():
            good.append(offset)
    return min(good, key=lambda offset: offset.translation_rms) if good else None


def _rms(poses: Floats, truth: Floats) -> Floats:
    """Return the RMS (2,) of angles in degrees and of distances between poses (n, 4, 4)."""
    twists = rigid.twist_between(poses, truth).reshape(-1, 2, 3)
    rms = np.sqrt((twists**2).sum(axis=2).mean(axis=0))[::-1]
    return np.asarray(rms * [180 / np.pi, 1.0])

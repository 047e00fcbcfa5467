"""Poses against what all sensors observed: which feature is met by which detection, how far off.

`Matches` is the one record of this; noise, evidence, covariance, claims and reports read it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from mixpose.records import Floats, Indices, Mask


@dataclass(frozen=True, eq=False)
class Matches:
    """L sensors at the N features (nodes) of a body, at one pose, or by a leading axis at K.

    A feature that a sensor does not have in view has no weight, one that is not met has no share;
    what is not there has no offset and no Jacobian.  A sensor of one coordinate has 0 as its
    second.
    """

    names: tuple[str, ...]  # of the sensors
    dimensions: Indices  # (L,) coordinates of each
    sigmas: Floats  # (L,) σ_ε in sensor units
    weights: Floats  # (..., L, N) of the features in view; 0 of the others
    shares: Floats  # (..., L, N) how far each is met, 0 to its weight
    places: Floats  # (..., L, N, 2) where they are predicted, sensor units
    offsets: Floats  # (..., L, N, 2) observed minus predicted, σ_ε
    J: Floats  # (..., L, N, 2, 6) Jacobian of the predicted places by the pose, σ_ε
    detections: Indices  # (..., L, N) by which each is met; -1 for none
    explained: Floats  # (..., L) share of the sensor's density that the pose accounts for
    unseen: Floats  # (..., L) weight of the features that face the sensor outside its view
    count: Floats  # (..., L) number of detections
    crowd: Floats  # (..., L) of them per m-th power of σ_ε, around the prediction
    unmatched_nearby: Floats  # (..., L) of no feature, about the body, where some feature is missed
    finest: Floats  # (..., L) narrowest blur at which the density can be looked up, σ_ε
    by_calibration: Floats | None = None  # (..., L, N, 2, Q) offsets, σ_ε, by Q stated errors

    def at(self, index: int | list[int] | None) -> Matches:
        """At one of K poses; None makes K = 1 of one."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _BY_POSE}
        for name, array in arrays.items():
            arrays[name] = None if array is None else array[index]
        return replace(self, **arrays)

    def of_sensors(self, chosen: Sequence[int] | Mask | Indices) -> Matches:
        """Some of the sensors, by numbers or a mask, at one pose."""
        numbers = np.arange(len(self.names))[np.asarray(chosen)].tolist()
        return replace(
            self.at(numbers),
            names=tuple([self.names[k] for k in numbers]),
            dimensions=self.dimensions[numbers],
            sigmas=self.sigmas[numbers],
        )

    @classmethod
    def stacked(cls, poses: Sequence[Matches]) -> Matches:
        """K poses of the same sensors, of bodies of their own; fewer features are filled up."""
        if len(poses) == 1:
            return poses[0].at(None)
        most = max(one.weights.shape[1] for one in poses)
        stacks: dict[str, Any] = {}
        for name in _BY_POSE:
            parts = [getattr(one, name) for one in poses]
            if parts[0] is not None:
                sensors, *rest = parts[0].shape
                shape = (len(poses), sensors, most, *rest[1:]) if rest else (len(poses), sensors)
                stacks[name] = np.full(shape, -1 if name == "detections" else 0, parts[0].dtype)
                for stack, part in zip(stacks[name], parts):
                    stack[tuple(map(slice, part.shape))] = part
        return replace(poses[0], **stacks)

    @cached_property
    def squared(self) -> Floats:
        """Squared offsets (..., L, N), σ_ε²."""
        return np.asarray((self.offsets * self.offsets).sum(axis=-1))

    @cached_property
    def met(self) -> Floats:
        """Sum of the shares (..., L)."""
        return np.asarray(self.shares.sum(axis=-1))

    @cached_property
    def expected(self) -> Floats:
        """Sum of the weights in view (..., L)."""
        return np.asarray(self.weights.sum(axis=-1))

    @property
    def missed(self) -> Floats:
        """Weight in view that is not met (..., L)."""
        return self.expected - self.met

    @cached_property
    def coverage(self) -> Floats:
        """Share of the features that face each sensor that are met (..., L)."""
        return np.asarray(self.met / np.maximum(self.expected + self.unseen, 1e-12))

    @property
    def measurements(self) -> Floats:
        """Number of coordinates that are met (..., L)."""
        return self.met * self.dimensions

    @cached_property
    def squares(self) -> Floats:
        """Sum of the squared offsets (..., L), σ_ε²."""
        return np.asarray((self.shares * self.squared).sum(axis=-1))

    @cached_property
    def met_by(self) -> Indices:
        """By how many sensors each feature is met (..., N)."""
        return np.asarray(np.count_nonzero(self.shares, axis=-2))

    @property
    def rms(self) -> list[float | None]:
        """Root mean square of the offsets of each sensor at one pose, sensor units."""
        mean = self.sigmas * np.sqrt(self.squares / np.maximum(self.met, 1e-12))
        return [r if m > 0 else None for r, m in zip(mean.tolist(), self.met.tolist())]

    def rows(self) -> tuple[Floats, Floats]:
        """Jacobian (L, 2N, 6) and offsets (L, 2N) at one pose, by the roots of the shares."""
        roots = np.sqrt(self.shares)[..., None]
        L, N, m = self.offsets.shape
        J = (roots[..., None] * self.J).reshape(L, m * N, 6)
        return J, (roots * self.offsets).reshape(L, m * N)


_BY_SENSOR = ("names", "dimensions", "sigmas")
_BY_POSE = tuple([one.name for one in fields(Matches) if one.name not in _BY_SENSOR])

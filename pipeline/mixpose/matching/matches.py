"""Poses against what all sensors observed: which feature is met by which detection, how far off.

`Matches` is the one record of this; noise, evidence, covariance, claims and reports read it.
Arrays have the sensors before the features, and the poses before both where there are several:
(L, N) at one pose, (K, L, N) at K.  A feature that a sensor does not have in view has no weight,
one that is not met has no share; what is not there has no offset and no Jacobian.  Offsets and
Jacobians are in σ_ε of their sensor; a sensor of one coordinate has 0 as its second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mixpose.records import Floats, Indices, Mask


@dataclass(frozen=True, eq=False)
class Matches:
    """L sensors at the N features (nodes) of a body.

    Attributes
    ----------
    names : tuple of str
        Of the sensors.
    dimensions : (L,) int
        Coordinates of each sensor.
    sigmas : (L,) float64
        σ_ε in sensor units.
    weights : (..., L, N)
        Of the features in view; 0 of the others.
    shares : (..., L, N)
        How far each is met, 0 to its weight.
    places : (..., L, N, 2)
        Where they are predicted, sensor units.
    offsets : (..., L, N, 2)
        Observed minus predicted place, σ_ε; of a merged pair that of its middle.
    J : (..., L, N, 2, 6)
        Jacobian of the predicted places by the pose, σ_ε.
    detections : (..., L, N) int
        By which detection each is met; -1 for none.
    explained : (..., L)
        Share of the sensor's density that the pose accounts for.
    unseen : (..., L)
        Weight of the features that face the sensor outside its view.
    merged : (..., L) int
        Pairs of features that share a detection.
    count : (..., L)
        Number of detections.
    crowd : (..., L)
        Detections per m-th power of σ_ε, around the prediction.
    unmatched_nearby : (..., L)
        Detections around the body that are no feature's, where some feature is missed.
    finest : (..., L)
        Narrowest blur at which the sensor's density can be looked up, σ_ε.
    by_calibration : (..., L, N, 2, Q) or None
        By how much a feature is elsewhere, in σ_ε, for calibrations off by one standard deviation.
    """

    names: tuple[str, ...]
    dimensions: Indices
    sigmas: Floats
    weights: Floats
    shares: Floats
    places: Floats
    offsets: Floats
    J: Floats
    detections: Indices
    explained: Floats
    unseen: Floats
    merged: Indices
    count: Floats
    crowd: Floats
    unmatched_nearby: Floats
    finest: Floats
    by_calibration: Floats | None = None

    def at(self, pose: int) -> Matches:
        """At one of K poses."""
        return self._part(pose)

    def of_sensors(self, chosen: Sequence[int] | Mask | Indices) -> Matches:
        """Some of the sensors, by numbers or a mask, at one pose."""
        numbers = np.arange(len(self.names))[np.asarray(chosen)].tolist()
        names = tuple([self.names[k] for k in numbers])
        per_sensor = self.dimensions[numbers], self.sigmas[numbers]
        some = self._part(numbers)
        return replace(some, names=names, dimensions=per_sensor[0], sigmas=per_sensor[1])

    def _part(self, index: int | list[int] | None) -> Matches:
        parts: list[Any] = [getattr(self, name) for name in _PER_POSE]
        parts = [None if array is None else array[index] for array in parts]
        return Matches(self.names, self.dimensions, self.sigmas, *parts)

    @classmethod
    def stacked(cls, poses: Sequence[Matches]) -> Matches:
        """K poses of the same sensors, of bodies of their own; fewer features are filled up."""
        first, most = poses[0], max(one.weights.shape[-1] for one in poses)
        if len(poses) == 1:
            return first._part(None)
        arrays: list[Any] = []
        for name in _PER_POSE:
            parts = [getattr(one, name) for one in poses]
            if any(part is None for part in parts):
                arrays.append(None)
            else:
                arrays.append(np.stack([_filled(part, most, name) for part in parts]))
        return cls(first.names, first.dimensions, first.sigmas, *arrays)

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


_PER_POSE = tuple(one.name for one in fields(Matches))[3:]
_PER_FEATURE = ("weights", "shares", "places", "offsets", "J", "detections", "by_calibration")


def _filled(array: NDArray[Any], count: int, name: str) -> NDArray[Any]:
    """An array (L, N, ...) with `count` features; one (L,) as it is."""
    if name not in _PER_FEATURE or array.shape[1] == count:
        return array
    width = [(0, 0), (0, count - array.shape[1])] + [(0, 0)] * (array.ndim - 2)
    return np.pad(array, width, constant_values=-1 if name == "detections" else 0)

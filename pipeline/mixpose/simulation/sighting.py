"""What one sensor gets to see of a body at one moment, before anything is drawn.

Features that face away, lie outside the sensor or are hidden by chance are left out; false ones
are put in.  Images, profiles and tables of detections are all made from this.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, SegmentFeature
from mixpose.body.features import Feature, offsets
from mixpose.records import Floats
from mixpose.sensors import Sensor
from mixpose.sensors.base import Mask
from mixpose.simulation.options import SimulationOptions

_DIMMEST = 0.3  # of the mean brightness: a feature is never drawn dark
_PIECES = 32  # in which a line's image is measured


@dataclass(frozen=True)
class Sighting:
    """Spots in sensor coordinates.

    Attributes
    ----------
    points : (M, m) float64
        Places of the spots.
    levels : (M,) float64
        Their brightness; 1 for the mean feature.
    features : (M,) int
        The feature that a spot belongs to; numbers from N on are false features.
    """

    points: Floats
    levels: Floats
    features: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class View:
    """How one sensor looks at the body throughout a recording.

    Attributes
    ----------
    sensor : Sensor
    lowest, highest : (m,) float64
        Bounds of false features.
    levels : (N,) float64
        Brightness of the features.
    spacing : float
        Distance of the spots of which a line consists, sensor units.
    ridge : float
        Brightness of each of these spots; 0 shares that of one feature among them.
    """

    sensor: Sensor
    lowest: Floats
    highest: Floats
    levels: Floats
    spacing: float
    ridge: float = 0.0


def look(
    view: View,
    body: Body,
    T_world_object: Floats,
    options: SimulationOptions,
    rng: np.random.Generator,
    *,
    offsets: Floats | None = None,
) -> Sighting:
    """Decide what a sensor sees of a body.

    Parameters
    ----------
    view : View
    body : Body
    T_world_object : (4, 4) array
    options : SimulationOptions
        Of which `hidden`, `hidden_count`, `clutter` and `brightness_spread` count here.
    rng : Generator
        For what is hidden and what is false.
    offsets : (N, 3) array, optional
        Displacements of the features in the object's frame.
    """
    count = len(body)
    false = _false_features(options.clutter, view, rng)
    points = [false]
    levels = [brightness_levels(len(false), options.brightness_spread, rng)]
    owners = [*range(count, count + len(false))]
    seen = facing(view.sensor, body, T_world_object) & ~_hidden(count, options, rng)
    for i in np.flatnonzero(seen).tolist():
        T = T_world_object.copy()
        if offsets is not None:
            T[:3, 3] += T[:3, :3] @ offsets[i]
        y, shares = _spots(view, body.features[i], T)
        points.append(y)
        levels.append(view.levels[i] * shares)
        owners += [i] * len(y)
    return Sighting(np.concatenate(points), np.concatenate(levels), np.array(owners, np.intp))


def facing(sensor: Sensor, body: Body, T_world_object: Floats) -> Mask:
    """Which features (N,) turn their front to a sensor; all of a body without normals."""
    if body.normals is None:
        return np.ones(len(body), dtype=np.bool_)
    R = T_world_object[:3, :3]
    points = body.means @ R.T + T_world_object[:3, 3]
    return np.asarray(((body.normals @ R.T) * sensor.towards(points)).sum(axis=-1) > 0)


def brightness_levels(count: int, spread: float, rng: np.random.Generator) -> Floats:
    """Brightness (count,) about 1 with a standard deviation, never too dark to be seen."""
    return np.maximum(1.0 + spread * rng.standard_normal(count), _DIMMEST)


def displacements(body: Body, rng: np.random.Generator) -> Floats:
    """Displacements (N, 3) of the features, drawn from the spread that the body states."""
    draws = rng.uniform(np.finfo(np.float64).eps, 1.0, (len(body), 1, 4))
    pairs = zip(draws, body.features, strict=True)
    return np.array([offsets(u, f.covariance, f.spread)[0] for u, f in pairs])


def _hidden(count: int, options: SimulationOptions, rng: np.random.Generator) -> Mask:
    """Which features (N,) something stands before in this view."""
    hidden = rng.random(count) < options.hidden
    hidden[rng.permutation(count)[: options.hidden_count]] = True
    return hidden


def _false_features(mean: float, view: View, rng: np.random.Generator) -> Floats:
    """False features (n, m), evenly over the bounds; n has the given mean."""
    count = int(mean) + int(rng.random() < mean - int(mean))
    return np.asarray(rng.uniform(view.lowest, view.highest, (count, len(view.lowest))))


def _spots(view: View, feature: Feature, T_world_object: Floats) -> tuple[Floats, Floats]:
    """Places (K, m) and shares of brightness (K,) of one feature's visible spots."""
    R, t = T_world_object[:3, :3], T_world_object[:3, 3]
    points, shares = feature.nodes()
    if isinstance(feature, SegmentFeature):
        ends = np.array([feature.start, feature.end]) @ R.T + t
        count = _spot_count(view, ends)
        along = (np.arange(count) + 0.5)[:, None] / count
        y, visible = view.sensor.project(ends[0] + along * (ends[1] - ends[0]))
        shares = np.full(count, max(1.0 / count, view.ridge))
    else:
        y, visible = view.sensor.project(points @ R.T + t)
    return y[visible], shares[visible]


def _spot_count(view: View, ends_world: Floats) -> int:
    """How many spots a line needs so that they lie no farther apart than `spacing`."""
    along = np.linspace(0, 1, _PIECES + 1)[:, None]
    y, visible = view.sensor.project(ends_world[0] + along * (ends_world[1] - ends_world[0]))
    steps = np.linalg.norm(np.diff(y, axis=0), axis=1)[visible[1:] & visible[:-1]]
    longest = float(steps.max()) * _PIECES if len(steps) else 0.0
    return max(2, ceil(longest / view.spacing))

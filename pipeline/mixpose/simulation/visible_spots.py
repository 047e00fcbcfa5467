"""What one sensor gets to see of a body at one moment, before anything is drawn.

Features that face away, lie outside the sensor or are hidden by chance are left out; false ones
are put in.  Images, profiles and tables of detections are all made from this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil
from typing import Any, cast

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from mixpose import sensors
from mixpose.body import Body, SegmentFeature
from mixpose.body.features import Feature, offsets
from mixpose.records import Floats, Mask
from mixpose.rigid import transform
from mixpose.sensors import CloudSensor, Sensor
from mixpose.simulation.motion import PoseAt, Shutter
from mixpose.simulation.options import SimulationOptions
from mixpose.simulation.scenery import Actor, Scenery

_DIMMEST = 0.3  # of the mean brightness: a feature is never drawn dark
_CORE = 0.45  # of a body's radius: what others are hidden behind
_PIECES = 32  # in which a line's image is measured
CORNERS = 180  # of an outline: of a circle, half a thousandth of the radius is left out
_ROWS_PER_PIXEL = 16

_AROUND = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
_CIRCLE = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=-1)


@dataclass(frozen=True)
class VisibleSpots:
    """Spots in sensor coordinates."""

    points: Floats  # (M, m), places of the spots
    levels: Floats  # (M,), their brightness; 1 for the mean feature
    features: NDArray[np.intp]  # (M,), that spots belong to; numbers from N on are false features
    outlines: Mapping[int, Floats] = field(default_factory=dict)  # edges (K, 2) of sized spots
    covers: tuple[Floats, ...] = ()  # corners (4, 2) of what is dark before all spots

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class View:
    """How one sensor looks at the body throughout a recording."""

    sensor: Sensor
    lowest: Floats  # (m,): bounds of false features
    highest: Floats
    levels: Floats  # (N,), brightness of the features
    spacing: float  # distance of the spots of which a line consists, sensor units
    ridge: float = 0.0  # brightness of each of these spots; 0 shares that of one feature among them
    shutter: Shutter = Shutter()
    scenery: Scenery = Scenery()

    @cached_property
    def unbounded(self) -> Sensor:
        """The sensor of an image without end."""
        sensor: Any = self.sensor
        return cast("Sensor", replace(sensor, resolution=None))


def look(
    view: View,
    body: Body,
    T_world_object: Floats,
    options: SimulationOptions,
    rng: Generator,
    *,
    offsets: Floats | None = None,
    pose_after: PoseAt | None = None,
    time_s: float = 0.0,
    is_away: bool = False,
) -> VisibleSpots:
    """Decide what a sensor sees of a body at T_world_object (4, 4) at the frame's time.

    Features are displaced by `offsets` (N, 3) in the object's frame; without `pose_after`, poses
    later by some seconds, the body stands still; `time_s` since the motion began is for what else
    moves.
    """
    count = len(body)
    # evenly over the bounds, their number of the given mean
    least = int(options.clutter)
    false_count = least + int(rng.random() < options.clutter - least)
    false = rng.uniform(view.lowest, view.highest, (false_count, len(view.lowest)))
    spots = _Spots([false], [brightness_levels(len(false), options.brightness_spread, rng)])
    spots.owners += range(count, count + len(false))
    own = Actor(body, pose_after or (lambda _: T_world_object), view.levels, is_body=True)
    actors = [own, *view.scenery.actors]
    poses = [T_world_object, *(actor.pose(time_s) for actor in view.scenery.actors)]
    means = [actor.body.means.mean(axis=0)[None] for actor in actors]
    middles = [transform(T, mean)[0] for T, mean in zip(poses, means, strict=True)]
    radii = [0.0 if one is own and is_away else _CORE * one.body.radius for one in actors]
    for actor, T in zip(actors, poses, strict=True):
        seen = facing(view.sensor, actor.body, T, actor.mirror)
        if actor.is_body:
            seen &= ~_hidden(len(actor.body), options, rng)
            cores = zip(actors, middles, radii, strict=True)
            others = [(m, r) for one, m, r in cores if one.is_body and one is not actor]
            seen &= ~hidden_behind(view.sensor, transform(T, actor.body.means), others)
        if is_away and (actor is own or actor.is_image):
            continue
        pose_later = own.pose if actor is own else later(actor.pose, time_s)
        first = 0 if actor is own else count + len(false)
        for i in np.flatnonzero(seen).tolist():
            offset = offsets[i] if actor is own and offsets is not None else np.zeros(3)
            spots.add(view, actor, i, first + i, pose_later, offset)
    late = time_s + view.shutter.late_s
    covers = [arm.outline(view.unbounded, late) for arm in view.scenery.arms]
    return spots.visible(tuple(one for one in covers if len(one)))


def hidden_behind(sensor: Sensor, points: Floats, others: Sequence[tuple[Floats, float]]) -> Mask:
    """Which points (n, 3) a core stands before, by the middle and radius of each."""
    hidden = np.zeros(len(points), dtype=np.bool_)
    if isinstance(sensor, CloudSensor):  # seen from several sides
        return hidden
    towards = sensor.towards(points)
    lengths = np.linalg.norm(towards, axis=1)
    units = towards / lengths[:, None]
    for middle, radius in others:
        arms = middle - points
        along = (arms * units).sum(axis=1)
        across = np.linalg.norm(arms - along[:, None] * units, axis=1)
        hidden |= (across < radius) & (along > 0)
    return hidden


def later(pose: PoseAt, time_s: float) -> PoseAt:
    """Poses so many seconds after a time."""
    return lambda seconds: pose(time_s + seconds)


@dataclass
class _Spots:
    """All that one sensor sees of a frame, while they are put together."""

    points: list[Floats]
    levels: list[Floats]
    owners: list[int] = field(default_factory=list)
    outlines: dict[int, Floats] = field(default_factory=dict)

    def add(
        self,
        view: View,
        actor: Actor,
        feature: int,
        owner: int,
        pose_after: PoseAt,
        offset: Floats,
    ) -> None:
        """Add what is seen of one feature, at each moment of its exposure."""
        body, mirror, sensor = actor.body, actor.mirror, view.sensor
        has_size = sensor.dimension == 2 and body.radii is not None and body.radii[feature] > 0
        poses = view.shutter.poses(sensor, body.means[feature], pose_after)
        for pose in poses:
            T = pose.copy()
            T[:3, 3] += T[:3, :3] @ offset
            edge = outline(view.unbounded, body, feature, T, mirror) if has_size else None
            if edge is None:
                y, shares = _spots(
                    view, body.features[feature], T if mirror is None else mirror @ T
                )
            else:
                y, shares = centroid(edge)[None], np.ones(1)
                if (y < sensor.lower).any() or (y > sensor.upper).any():
                    continue
                self.outlines[len(self.owners)] = edge
            self.points.append(y)
            self.levels.append(actor.levels[feature] * shares / len(poses))
            self.owners += [owner] * len(y)

    def visible(self, covers: tuple[Floats, ...]) -> VisibleSpots:
        """All of them."""
        points, levels = np.concatenate(self.points), np.concatenate(self.levels)
        return VisibleSpots(points, levels, np.array(self.owners, np.intp), self.outlines, covers)


def facing(
    sensor: Sensor, body: Body, T_world_object: Floats, mirror: Floats | None = None
) -> Mask:
    """Which features (N,) turn their front to a sensor; all of a body without normals."""
    M = T_world_object if mirror is None else mirror @ T_world_object
    return sensors.facing(sensor, M, transform(M, body.means), body.normals)


def brightness_levels(count: int, spread: float, rng: Generator) -> Floats:
    """Brightness (count,) about 1 with a standard deviation, never too dark to be seen."""
    return np.maximum(1.0 + spread * rng.standard_normal(count), _DIMMEST)


def displacements(body: Body, T_world_object: Floats, rng: Generator) -> Floats:
    """Displacements (N, 3) in the body's axes, drawn from its spread; gravity's by its pose."""
    draws = rng.uniform(np.finfo(np.float64).eps, 1.0, (len(body), 1, 4))
    pairs = zip(draws, body.features, strict=True)
    drawn = np.array([offsets(u, f.covariance, f.spread)[0] for u, f in pairs])
    if body.gravity is None:
        return drawn
    along = body.gravity.sigma * rng.standard_normal((len(body), 1)) * body.gravity.unit
    return np.asarray(drawn + along @ T_world_object[:3, :3])


def _hidden(count: int, options: SimulationOptions, rng: Generator) -> Mask:
    """Which features (N,) something stands before in this view."""
    hidden = rng.random(count) < options.hidden
    hidden[rng.permutation(count)[: options.hidden_count]] = True
    return hidden


def _spots(view: View, feature: Feature, T_world_object: Floats) -> tuple[Floats, Floats]:
    """Places (K, m) and shares of brightness (K,) of one feature's visible spots."""
    points, shares = feature.nodes()
    if isinstance(feature, SegmentFeature):
        ends = transform(T_world_object, np.array([feature.start, feature.end]))
        # so many that they lie no farther apart than `spacing`
        pieces = np.linspace(0, 1, _PIECES + 1)[:, None]
        y, visible = view.sensor.project(ends[0] + pieces * (ends[1] - ends[0]))
        steps = np.linalg.norm(np.diff(y, axis=0), axis=1)[visible[1:] & visible[:-1]]
        longest = float(steps.max()) * _PIECES if len(steps) else 0.0
        count = max(2, ceil(longest / view.spacing))
        along = (np.arange(count) + 0.5)[:, None] / count
        y, visible = view.sensor.project(ends[0] + along * (ends[1] - ends[0]))
        shares = np.full(count, max(1.0 / count, view.ridge))
    else:
        y, visible = view.sensor.project(transform(T_world_object, points))
    return y[visible], shares[visible]


def outline(
    sensor: Sensor, body: Body, feature: int, T_world_object: Floats, mirror: Floats | None = None
) -> Floats | None:
    """Where the edge (CORNERS, 2) of a sphere or disk is seen, px; None where not all of it is.

    `sensor` should have no bounds: what lies beyond an image has no place in it. Through a `mirror`
    (4, 4) that is a reflection of the world.
    """
    assert body.radii is not None, "a body of points has no outlines"
    radius = float(body.radii[feature])
    M = T_world_object if mirror is None else mirror @ T_world_object
    centre = M[:3, :3] @ body.means[feature] + M[:3, 3]
    if body.shape == "disk" and body.normals is not None:
        axis = M[:3, :3] @ body.normals[feature]
    else:
        # the circle at which lines of sight touch the sphere
        towards = sensor.towards(centre)
        distance = float(np.linalg.norm(towards))
        if distance <= radius:
            return None
        axis = towards / distance
        centre = centre + axis * radius**2 / distance
        radius *= float(np.sqrt(1 - (radius / distance) ** 2))
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(axis, first)])
    y, visible = sensor.project(centre + radius * _CIRCLE @ plane)
    return y if visible.all() else None


def centroid(polygon: Floats) -> Floats:
    """Centroid (2,) of the area that a polygon (n, 2) encloses."""
    middle = polygon.mean(axis=0)
    x, y = (polygon - middle).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    return np.asarray(
        middle + [(cross * (one + np.roll(one, -1))).sum() / (3 * cross.sum()) for one in (x, y)]
    )


def coverage(polygon: Floats, shape: tuple[int, int]) -> tuple[slice, slice, Floats]:
    """Share of every pixel that a convex polygon covers, in a box of an image of a shape (H, W).

    The corners (n, 2) are (u, v) in order, pixel centres at integers. Rows and columns of the box
    are empty where the polygon is outside of the image.
    """
    low = np.clip(np.floor(polygon.min(axis=0) + 0.5).astype(int), 0, shape[::-1])
    high = np.clip(np.ceil(polygon.max(axis=0) + 0.5).astype(int), 0, shape[::-1])
    rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
    height, width = max(high[1] - low[1], 0), max(high[0] - low[0], 0)
    if not height or not width:
        return rows, columns, np.zeros((height, width))
    lines = (np.arange(height * _ROWS_PER_PIXEL) + 0.5) / _ROWS_PER_PIXEL - 0.5 + low[1]
    # where horizontal lines enter and leave it; alike where they miss it
    top, bottom = int(polygon[:, 1].argmin()), int(polygon[:, 1].argmax())
    turned, turn = np.roll(polygon, -top, axis=0), (bottom - top) % len(polygon)
    sides = [turned[: turn + 1], np.concatenate([turned[turn:], turned[:1]])[::-1]]
    one, other = (np.interp(lines, side[:, 1], side[:, 0]) for side in sides)
    left, right = np.minimum(one, other), np.maximum(one, other)
    right = np.where((lines < polygon[top, 1]) | (lines > polygon[bottom, 1]), left, right)
    edges = np.arange(width) + low[0] - 0.5
    within = np.clip(right[:, None] - edges, 0, 1) - np.clip(left[:, None] - edges, 0, 1)
    return rows, columns, within.reshape(height, _ROWS_PER_PIXEL, width).mean(axis=1)

"""Decide what one sensor sees of a body at one moment, before anything is drawn.

Features that face away, lie outside the sensor or are hidden by chance are left out, and false ones
are added.  Images, profiles and tables of detections are all made from the result.
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

_DIMMEST = 0.3  # of the mean brightness: features are at least so bright
_CORE = 0.45  # of a body's radius: the opaque core that hides features behind it
_PIECES = 32  # in which the image of a line is measured
CORNERS = 180  # of an outline: half a thousandth of a circle's radius is cut off
_ROWS_PER_PIXEL = 16

_AROUND = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
_CIRCLE = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=-1)


@dataclass(frozen=True)
class VisibleSpots:
    """Spots in sensor coordinates."""

    points: Floats  # (M, m): positions
    levels: Floats  # (M,): brightness; 1 for the mean feature
    features: NDArray[np.intp]  # (M,): feature of each spot; from N on false features
    outlines: Mapping[int, Floats] = field(default_factory=dict)  # (K, 2) of spots with a size
    occluders: tuple[Floats, ...] = ()  # corners (4, 2) of dark areas in front of all spots

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class View:
    """The view of one sensor throughout a recording."""

    sensor: Sensor
    lowest: Floats  # (m,): bounds of false features
    highest: Floats  # (m,)
    levels: Floats  # (N,): brightness of the features
    spacing: float  # distance between the spots of a line, sensor units
    ridge: float = 0.0  # brightness of each of these spots; 0: they share that of one feature
    shutter: Shutter = Shutter()
    scenery: Scenery = Scenery()

    @cached_property
    def unbounded(self) -> Sensor:
        """The sensor with an image without bounds."""
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

    Features are displaced by `offsets` (N, 3) in the object's frame.  `pose_after` gives poses some
    seconds after the frame; without it the body stands still.  Other things are where they are at
    `time_s` since the motion began.
    """
    count = len(body)
    # uniform within the bounds; their number has the given mean
    least = int(options.clutter)
    false_count = least + int(rng.random() < options.clutter - least)
    clutter = rng.uniform(view.lowest, view.highest, (false_count, len(view.lowest)))
    levels = brightness_levels(false_count, options.brightness_spread, rng)
    spots = _Spots(view, [clutter], [levels], list(range(count, count + false_count)))
    subject = Actor(body, pose_after or (lambda _: T_world_object), view.levels, is_body=True)
    actors = [subject, *view.scenery.actors]
    poses = [T_world_object, *(actor.pose(time_s) for actor in view.scenery.actors)]
    middles = [transform(T, a.body.means.mean(axis=0)[None])[0] for T, a in zip(poses, actors)]
    radii = [_CORE * actor.body.radius for actor in actors]
    if is_away:
        radii[0] = 0.0
    for actor, T in zip(actors, poses, strict=True):
        seen = facing(view.sensor, actor.body, actor.seen_at(T))
        if actor.is_body:
            seen &= rng.random(len(seen)) >= options.hidden
            seen[rng.permutation(len(seen))[: options.hidden_count]] = False
            cores = zip(actors, middles, radii, strict=True)
            others = [(m, r) for other, m, r in cores if other.is_body and other is not actor]
            seen &= ~are_occluded(view.sensor, transform(T, actor.body.means), others)
        if is_away and (actor is subject or actor.is_body_image):
            continue
        pose_later = subject.pose if actor is subject else shifted(actor.pose, time_s)
        first = 0 if actor is subject else count + false_count
        for i in np.flatnonzero(seen).tolist():
            offset = offsets[i] if actor is subject and offsets is not None else np.zeros(3)
            spots.add(actor, i, first + i, pose_later, offset)
    seen_at_s = time_s + view.shutter.delay_s
    occluders = [arm.outline(view.unbounded, seen_at_s) for arm in view.scenery.arms]
    return spots.visible(tuple(corners for corners in occluders if len(corners)))


def are_occluded(sensor: Sensor, points: Floats, spheres: Sequence[tuple[Floats, float]]) -> Mask:
    """Test which points (n, 3) are behind opaque spheres, by the centre and radius of each."""
    is_hidden = np.zeros(len(points), dtype=np.bool_)
    if isinstance(sensor, CloudSensor):  # made by sensors on several sides
        return is_hidden
    to_sensor = sensor.towards(points)
    lengths = np.linalg.norm(to_sensor, axis=1)
    units = to_sensor / lengths[:, None]
    for centre, radius in spheres:
        to_centre = centre - points
        along = (to_centre * units).sum(axis=1)
        across = np.linalg.norm(to_centre - along[:, None] * units, axis=1)
        is_hidden |= (across < radius) & (along > 0)
    return is_hidden


def shifted(pose: PoseAt, time_s: float) -> PoseAt:
    """Return the poses by seconds after a time."""
    return lambda seconds: pose(time_s + seconds)


@dataclass
class _Spots:
    """All spots of one sensor in a frame, while they are collected."""

    view: View
    points: list[Floats]
    levels: list[Floats]
    owners: list[int]
    outlines: dict[int, Floats] = field(default_factory=dict)

    def add(
        self, actor: Actor, feature: int, owner: int, pose_after: PoseAt, offset: Floats
    ) -> None:
        """Add the spots of one feature, at each moment of the exposure."""
        view, body, sensor = self.view, actor.body, self.view.sensor
        has_size = sensor.dimension == 2 and body.radii is not None and body.radii[feature] > 0

        def seen_after(seconds: float) -> Floats:
            T = pose_after(seconds).copy()
            T[:3, 3] += T[:3, :3] @ offset
            return actor.seen_at(T)

        # a mirror image is read where it is seen
        motions = view.shutter.poses(sensor, body.means[feature], seen_after)
        for M in motions:
            edge = outline(view.unbounded, body, feature, M) if has_size else None
            if edge is None:
                y, shares = _spots(view, body.features[feature], M)
            else:
                y, shares = centroid(edge)[None], np.ones(1)
                if (y < sensor.lower).any() or (y > sensor.upper).any():
                    continue
                self.outlines[len(self.owners)] = edge
            self.points.append(y)
            self.levels.append(actor.levels[feature] * shares / len(motions))
            self.owners += [owner] * len(y)

    def visible(self, occluders: tuple[Floats, ...]) -> VisibleSpots:
        """Return all spots."""
        points, levels = np.concatenate(self.points), np.concatenate(self.levels)
        owners = np.array(self.owners, np.intp)
        return VisibleSpots(points, levels, owners, self.outlines, occluders)


def facing(sensor: Sensor, body: Body, T_world_object: Floats) -> Mask:
    """Test which features (N,) face a sensor; all of a body without normals."""
    points = transform(T_world_object, body.means)
    return sensors.facing(sensor, T_world_object, points, body.normals)


def brightness_levels(count: int, spread: float, rng: Generator) -> Floats:
    """Draw brightness (count,) about 1 with a standard deviation, never too dark to be seen."""
    return np.maximum(1.0 + spread * rng.standard_normal(count), _DIMMEST)


def displacements(body: Body, T_world_object: Floats, rng: Generator) -> Floats:
    """Draw displacements (N, 3) in the body's axes, by its spread and its spread along gravity."""
    draws = rng.uniform(np.finfo(np.float64).eps, 1.0, (len(body), 1, 4))
    pairs = zip(draws, body.features, strict=True)
    drawn = np.array([offsets(u, f.covariance, f.spread)[0] for u, f in pairs])
    if body.gravity is None:
        return drawn
    along = body.gravity.sigma * rng.standard_normal((len(body), 1)) * body.gravity.unit
    return np.asarray(drawn + along @ T_world_object[:3, :3])


def _spots(view: View, feature: Feature, T_world_object: Floats) -> tuple[Floats, Floats]:
    """Return positions (K, m) and shares of brightness (K,) of one feature's visible spots."""
    points, shares = feature.nodes()
    if isinstance(feature, SegmentFeature):
        ends = transform(T_world_object, np.array([feature.start, feature.end]))
        # enough spots that they are at most `spacing` apart
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


def outline(sensor: Sensor, body: Body, feature: int, M: Floats) -> Floats | None:
    """Return the outline (CORNERS, 2) of a sphere or disk, px; None if not all of it is in view.

    `sensor` should have no bounds, as parts beyond an image have no projection in it.  M (4, 4) is
    the pose T_world_object or, of a mirror image, its reflection.
    """
    assert body.radii is not None, "a body of points has no outlines"
    radius = float(body.radii[feature])
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
    """Return the centroid (2,) of the area of a polygon (n, 2)."""
    centre = polygon.mean(axis=0)
    x, y = (polygon - centre).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    shift = [(cross * (axis + np.roll(axis, -1))).sum() / (3 * cross.sum()) for axis in (x, y)]
    return np.asarray(centre + shift)


def coverage(polygon: Floats, shape: tuple[int, int]) -> tuple[slice, slice, Floats]:
    """Return the share of each pixel that a convex polygon covers, in a box of an image (H, W).

    The corners (n, 2) are (u, v) in order, pixel centres at integers.  Rows and columns of the box
    are empty if the polygon is outside of the image.
    """
    low = np.clip(np.floor(polygon.min(axis=0) + 0.5).astype(int), 0, shape[::-1])
    high = np.clip(np.ceil(polygon.max(axis=0) + 0.5).astype(int), 0, shape[::-1])
    rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
    height, width = max(high[1] - low[1], 0), max(high[0] - low[0], 0)
    if not height or not width:
        return rows, columns, np.zeros((height, width))
    lines = (np.arange(height * _ROWS_PER_PIXEL) + 0.5) / _ROWS_PER_PIXEL - 0.5 + low[1]
    # u at which horizontal lines enter and leave it; equal for lines that miss it
    top, bottom = int(polygon[:, 1].argmin()), int(polygon[:, 1].argmax())
    turned, turn = np.roll(polygon, -top, axis=0), (bottom - top) % len(polygon)
    sides = [turned[: turn + 1], np.concatenate([turned[turn:], turned[:1]])[::-1]]
    first, second = (np.interp(lines, side[:, 1], side[:, 0]) for side in sides)
    left, right = np.minimum(first, second), np.maximum(first, second)
    right = np.where((lines < polygon[top, 1]) | (lines > polygon[bottom, 1]), left, right)
    edges = np.arange(width) + low[0] - 0.5
    within = np.clip(right[:, None] - edges, 0, 1) - np.clip(left[:, None] - edges, 0, 1)
    return rows, columns, within.reshape(height, _ROWS_PER_PIXEL, width).mean(axis=1)

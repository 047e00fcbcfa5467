"""What else is before the cameras: lamps, a polished table, the markers of others, an arm.

Placed about the middle of the body's motion, between what the cameras look at and beyond, and drawn
from a seed.  Sensors of ranges know nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from mixpose.body import Body, PointFeature
from mixpose.records import Floats
from mixpose.rigid import from_rotation_vector
from mixpose.sensors import Sensor
from mixpose.simulation.motion import Motion, PoseAt, plan_motion
from mixpose.simulation.options import Purpose, SimulationOptions, generator

_LAMP = 0.12  # of the body's radius
_LAMP_LEVEL = 3.0  # of a marker: the image is white there
_LAMPS_AWAY = (3.0, 6.0)  # radii behind the body
_LAMPS_ASIDE = 3.0
_TABLE_BELOW = 1.3  # radii under the middle of the motion
_OTHERS_ASIDE = (2.2, 3.2)
_OTHERS_MOVE = 0.3
_ARM_BEFORE = 2.5  # radii towards the cameras
_ARM_SWING = 1.5
_ARM_LENGTH = 8.0
_ARM_WIDTH = 0.22
_ARM_PERIOD = 0.8  # of that of the body


@dataclass(frozen=True)
class Actor:
    """Markers that are no part of the body."""

    body: Body
    pose: PoseAt  # from seconds to T_world_object (4, 4)
    levels: Floats  # (N,) of brightness
    mirror: Floats | None = None  # reflection (4, 4) of the world in which they are seen
    is_image: bool = False  # whether they are a mirror image of the body, and gone when it is
    is_body: bool = False  # another body of the session: solid, and hidden by others now and then


@dataclass(frozen=True)
class Arm:
    """A straight dark bar that swings before the body."""

    ends: Floats  # (2, 3), at rest, in the world
    swing: Floats  # (3,), farthest displacement
    period_s: float
    phase: float
    radius: float  # half its width

    def outline(self, sensor: Sensor, time_s: float) -> Floats:
        """Corners (4, 2) of the bar in a sensor without bounds, px; none where it is not seen."""
        ends = self.ends + self.swing * np.sin(2 * np.pi * time_s / self.period_s + self.phase)
        along = ends[1] - ends[0]
        across = np.cross(along, sensor.towards(ends.mean(axis=0)))
        across *= self.radius / np.linalg.norm(across)
        corners = [ends[0] + across, ends[1] + across, ends[1] - across, ends[0] - across]
        y, visible = sensor.project(np.array(corners))
        return y if visible.all() else y[:0]


@dataclass(frozen=True)
class Scenery:
    """All that is before the cameras beside the body."""

    actors: tuple[Actor, ...] = ()
    arms: tuple[Arm, ...] = ()


def plan_scenery(
    body: Body, motion: Motion, cameras: Sequence[Sensor], options: SimulationOptions
) -> Scenery:
    """Place what the options ask for about a body in front of cameras."""
    wanted = options.lamps or options.others or options.occluder or options.mirror
    if not cameras or not wanted:
        return Scenery()
    rng = generator(options.seed, Purpose.SCENERY)
    R, t = motion.T_world_object[:3, :3], motion.T_world_object[:3, 3]
    middle = R @ motion.pivot + t
    front = _unit(np.mean([_unit(camera.towards(middle)) for camera in cameras], axis=0))
    downs = []  # where rows of images go in the world: a small step that is seen below
    for camera in cameras:
        _, J, _ = camera.linearise(middle)
        downs.append(_unit(J[1] - J[0] * (J[0] @ J[1]) / max(float(J[0] @ J[0]), 1e-300)))
    down = _unit(np.mean(downs, axis=0))
    side = _unit(np.cross(front, down))
    stage = _Stage(body, middle, np.stack([side, down, front]), options, rng)
    lamps = [stage.lamp() for _ in range(options.lamps)]
    others = [stage.other(k) for k in range(options.others)]
    images = []
    if options.mirror:
        # the map of the world onto its mirror image in the table
        mirror, plane = np.eye(4), middle + _TABLE_BELOW * body.radius * down
        mirror[:3, :3] -= 2 * np.outer(down, down)
        mirror[:3, 3] = 2 * (plane @ down) * down
        levels = np.full(len(body), options.mirror)
        images = [Actor(body, motion.pose, levels, mirror, is_image=True)]
        images += [Actor(o.body, o.pose, options.mirror * o.levels, mirror) for o in others]
    arms = tuple(stage.arm() for _ in range(options.occluder))
    return Scenery((*lamps, *others, *images), arms)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True)
class _Stage:
    """The surroundings of a body, of which scenery is drawn."""

    body: Body
    middle: Floats  # (3,)
    frame: Floats  # (3, 3), rows to the side, down and to the front, as cameras see it
    options: SimulationOptions
    rng: Generator

    def lamp(self) -> Actor:
        """A lamp behind the body that stays where it is."""
        radius, rng = self.body.radius, self.rng
        aside = rng.uniform(-_LAMPS_ASIDE, _LAMPS_ASIDE, 2)
        place = self.middle + radius * (np.array([*aside, -rng.uniform(*_LAMPS_AWAY)]) @ self.frame)
        radii = np.array([_LAMP * radius])
        lamp = Body("lamp", (PointFeature(place),), None, None, "sphere", radii)
        return Actor(lamp, lambda _: np.eye(4), np.array([_LAMP_LEVEL]))

    def other(self, index: int) -> Actor:
        """As many markers as the body has, elsewhere on another body that moves by itself."""
        body, options, rng, count = self.body, self.options, self.rng, len(self.body)
        directions = rng.standard_normal((count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        places = body.radius * directions * rng.uniform(0.3, 1.0, (count, 1))
        normals = None if body.normals is None else np.tile(self.frame[2], (count, 1))
        features = tuple(PointFeature(place) for place in places)
        radii = None if body.radii is None else np.full(count, float(np.median(body.radii)))
        other = Body("other", features, normals, None, body.shape, radii)
        angle = rng.uniform(0, 2 * np.pi)
        aside = rng.uniform(*_OTHERS_ASIDE) * np.array([np.cos(angle), np.sin(angle), 0.0])
        turn = 0.3 * rng.standard_normal(3)
        motion = plan_motion(
            from_rotation_vector(turn, self.middle + body.radius * (aside @ self.frame)),
            np.zeros(3),
            translation=_OTHERS_MOVE * body.radius,
            rotation_deg=options.amplitude_rotation_deg,
            period_s=options.period_s,
            seed=options.seed + 7919 * (index + 1),
        )
        return Actor(other, motion.pose, np.ones(count))

    def arm(self) -> Arm:
        """A bar across the view that swings over the body and beside it."""
        radius, angle = self.body.radius, self.rng.uniform(0, np.pi)
        along = np.array([np.cos(angle), np.sin(angle), 0.0]) @ self.frame
        swing = np.array([-np.sin(angle), np.cos(angle), 0.0]) @ self.frame
        centre = self.middle + _ARM_BEFORE * radius * self.frame[2]
        reach = 0.5 * _ARM_LENGTH * radius * along
        return Arm(
            np.array([centre - reach, centre + reach]),
            _ARM_SWING * radius * swing,
            _ARM_PERIOD * self.options.period_s,
            self.rng.uniform(0, 2 * np.pi),
            _ARM_WIDTH * radius,
        )

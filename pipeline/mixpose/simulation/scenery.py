"""What cameras see besides the body: lamps, a reflecting table, other bodies' markers, an arm.

It is placed around the centre of the body's motion, and drawn from a seed.  Range sensors do not
see it.
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

_LAMP = 0.12  # radius, of that of the body
_LAMP_LEVEL = 3.0  # brightness, of that of a marker: the image is saturated
_LAMPS_AWAY = (3.0, 6.0)  # radii behind the body
_LAMPS_ASIDE = 3.0
_TABLE_BELOW = 1.3  # radii below the centre of the motion
_OTHERS_ASIDE = (2.2, 3.2)
_OTHERS_MOVE = 0.3
_ARM_BEFORE = 2.5  # radii towards the cameras
_ARM_SWING = 1.5
_ARM_LENGTH = 8.0
_ARM_WIDTH = 0.22
_ARM_PERIOD = 0.8  # of the period of the body


@dataclass(frozen=True)
class Actor:
    """Features in view: markers of a body, lamps, or mirror images of markers."""

    body: Body
    pose: PoseAt  # T_world_object (4, 4) by seconds
    levels: Floats  # (N,): brightness
    mirror: Floats | None = None  # reflection (4, 4) of the world in which they are seen
    is_body_image: bool = False  # a mirror image of the body, which is away when the body is
    is_body: bool = False  # a body of the session: solid, some features hidden by chance

    def seen_at(self, T_world_object: Floats) -> Floats:
        """Return the motion (4, 4) from the object to where it is seen, perhaps in a mirror."""
        return T_world_object if self.mirror is None else self.mirror @ T_world_object


@dataclass(frozen=True)
class Arm:
    """A straight dark bar that swings before the body."""

    ends: Floats  # (2, 3): at rest, in the world
    swing: Floats  # (3,): largest displacement
    period_s: float
    phase: float
    radius: float  # half its width

    def outline(self, sensor: Sensor, time_s: float) -> Floats:
        """Return the corners (4, 2) of the bar in a sensor without bounds, px; none if not seen."""
        ends = self.ends + self.swing * np.sin(2 * np.pi * time_s / self.period_s + self.phase)
        along = ends[1] - ends[0]
        across = np.cross(along, sensor.towards(ends.mean(axis=0)))
        across *= self.radius / np.linalg.norm(across)
        corners = [ends[0] + across, ends[1] + across, ends[1] - across, ends[0] - across]
        y, visible = sensor.project(np.array(corners))
        return y if visible.all() else y[:0]


@dataclass(frozen=True)
class Scenery:
    """All that cameras see besides the body."""

    actors: tuple[Actor, ...] = ()
    arms: tuple[Arm, ...] = ()


def plan_scenery(
    body: Body, motion: Motion, cameras: Sequence[Sensor], options: SimulationOptions
) -> Scenery:
    """Place the scenery that the options ask for around a body in front of cameras."""
    is_wanted = options.lamps or options.others or options.occluder or options.mirror
    if not cameras or not is_wanted:
        return Scenery()
    rng = generator(options.seed, Purpose.SCENERY)
    R, t = motion.T_world_object[:3, :3], motion.T_world_object[:3, 3]
    centre = R @ motion.pivot + t
    front = _unit(np.mean([_unit(camera.towards(centre)) for camera in cameras], axis=0))
    downs = []  # directions in the world that are seen as down in each image
    for camera in cameras:
        _, J, _ = camera.linearise(centre)
        downs.append(_unit(J[1] - J[0] * (J[0] @ J[1]) / max(float(J[0] @ J[0]), 1e-300)))
    down = _unit(np.mean(downs, axis=0))
    side = _unit(np.cross(front, down))
    stage = _Stage(body, centre, np.stack([side, down, front]), options, rng)
    lamps = [stage.lamp() for _ in range(options.lamps)]
    others = [stage.other(k) for k in range(options.others)]
    images = []
    if options.mirror:
        # maps the world onto its mirror image in the table
        mirror, plane = np.eye(4), centre + _TABLE_BELOW * body.radius * down
        mirror[:3, :3] -= 2 * np.outer(down, down)
        mirror[:3, 3] = 2 * (plane @ down) * down
        levels = np.full(len(body), options.mirror)
        images = [Actor(body, motion.pose, levels, mirror, is_body_image=True)]
        images += [Actor(o.body, o.pose, options.mirror * o.levels, mirror) for o in others]
    arms = tuple(stage.arm() for _ in range(options.occluder))
    return Scenery((*lamps, *others, *images), arms)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True)
class _Stage:
    """The surroundings of a body, in which scenery is drawn."""

    body: Body
    centre: Floats  # (3,): of the motion
    frame: Floats  # (3, 3): unit vectors to the side, down and towards the cameras
    options: SimulationOptions
    rng: Generator

    def lamp(self) -> Actor:
        """Draw a lamp behind the body that does not move."""
        radius, rng = self.body.radius, self.rng
        aside = rng.uniform(-_LAMPS_ASIDE, _LAMPS_ASIDE, 2)
        place = self.centre + radius * (np.array([*aside, -rng.uniform(*_LAMPS_AWAY)]) @ self.frame)
        radii = np.array([_LAMP * radius])
        lamp = Body("lamp", (PointFeature(place),), None, None, "sphere", radii)
        return Actor(lamp, lambda _: np.eye(4), np.array([_LAMP_LEVEL]))

    def other(self, index: int) -> Actor:
        """Draw another body with as many markers, which moves by itself."""
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
            from_rotation_vector(turn, self.centre + body.radius * (aside @ self.frame)),
            np.zeros(3),
            translation=_OTHERS_MOVE * body.radius,
            rotation_deg=options.amplitude_rotation_deg,
            period_s=options.period_s,
            seed=options.seed + 7919 * (index + 1),
        )
        return Actor(other, motion.pose, np.ones(count))

    def arm(self) -> Arm:
        """Draw a bar across the view that swings over the body and past it."""
        radius, angle = self.body.radius, self.rng.uniform(0, np.pi)
        along = np.array([np.cos(angle), np.sin(angle), 0.0]) @ self.frame
        swing = np.array([-np.sin(angle), np.cos(angle), 0.0]) @ self.frame
        centre = self.centre + _ARM_BEFORE * radius * self.frame[2]
        reach = 0.5 * _ARM_LENGTH * radius * along
        ends, phase = np.array([centre - reach, centre + reach]), self.rng.uniform(0, 2 * np.pi)
        period_s = _ARM_PERIOD * self.options.period_s
        return Arm(ends, _ARM_SWING * radius * swing, period_s, phase, _ARM_WIDTH * radius)

"""The bodies of a session beside its first, where they are and how they move and hide each other.

A body whose ``[object.start]`` is known is there.  The others stand about the place where one body
alone would be, so far from each other that they touch by their motion at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import from_parts, rotation_matrix
from mixpose.session import Session
from mixpose.simulation.central_pose import central_pose, count_seen, pivot_of, swinging
from mixpose.simulation.motion import Motion
from mixpose.simulation.options import Purpose, SimulationOptions, generator
from mixpose.simulation.scenery import Actor, motion_pose
from mixpose.simulation.visible_spots import brightness_levels

_APART = 1.1  # sums of radii between bodies at rest
_TRIES = 48  # places at each distance
_DISTANCES = (1.2, 1.6, 2.2, 3.0, 4.0)  # radii of the largest
_SEEDS_APART = 101  # between the motions of bodies


@dataclass(frozen=True)
class Companion:
    """A body beside the first one of a session."""

    name: str
    instance: int | None
    body: Body
    motion: Motion
    actor: Actor


def plan_companions(
    session: Session, first: Motion, options: SimulationOptions
) -> tuple[Companion, ...]:
    """Place and move the bodies beside the first.

    A `SessionError` if there are some, and a sensor is no camera, or no place is left in view.
    """
    members = [(one, i) for one in session.objects for i in one.instances][1:]
    if not members:
        return ()
    if any(setup.sensor.dimension != 2 for setup in session.sensors):
        raise SessionError(
            f"{session.path}: object: found {len(members) + 1} bodies before sensors of ranges; "
            "simulate draws several bodies before cameras only"
        )
    placed = [(_middle(first.T_world_object, session.body), session.body.radius)]
    companions = []
    for k, (one, instance) in enumerate(members, start=1):
        own = session.alone(one.body.name)
        seed = options.seed + _SEEDS_APART * k
        is_at_start = one.start is not None and not instance
        T = central_pose(own, seed)
        if not is_at_start:
            T = _aside(own, T, placed, seed, turned=one.start is not None)
        placed.append((_middle(T, one.body), one.body.radius))
        motion = swinging(own, T, options, seed)
        rng = generator(seed, Purpose.BRIGHTNESS)
        levels = brightness_levels(len(one.body), options.brightness_spread, rng)
        actor = Actor(one.body, motion_pose(motion), levels, is_body=True)
        companions.append(Companion(one.body.name, instance, one.body, motion, actor))
    return tuple(companions)


def _middle(T_world_object: Floats, body: Body) -> Floats:
    return np.asarray(T_world_object[:3, :3] @ pivot_of(body) + T_world_object[:3, 3])


def _aside(
    session: Session,
    T: Floats,
    placed: Sequence[tuple[Floats, float]],
    seed: int,
    *,
    turned: bool,
) -> Floats:
    """A pose apart from all that are placed, as near as can be where most features are seen."""
    body = session.body
    rng = generator(seed, Purpose.ORIENTATION)
    largest = max([body.radius, *(radius for _, radius in placed)])
    for distance in _DISTANCES:
        best: tuple[int, Floats] | None = None
        for _ in range(_TRIES):
            direction = rng.standard_normal(3)
            shift = distance * largest * direction / np.linalg.norm(direction)
            middle = placed[0][0] + shift
            R = rotation_matrix(rng.standard_normal(3)) @ T[:3, :3] if turned else T[:3, :3]
            if any(
                np.linalg.norm(middle - other) < _APART * (body.radius + radius)
                for other, radius in placed
            ):
                continue
            there = from_parts(R, middle - R @ pivot_of(body))
            seen = count_seen(session, there)
            if best is None or seen > best[0]:
                best = seen, there
        if best is not None and best[0] == len(body) * len(session.sensors):
            return best[1]
    raise SessionError(
        f"{session.path}: object {body.name!r}: found no place apart from the other bodies in view "
        "of all cameras; give it an [object.start]"
    )


def moved(companions: Sequence[Companion], seconds: float, decimals: int) -> list[Floats]:
    """Where they are at a moment."""
    return [np.round(one.motion.poses(np.array(seconds)), decimals) + 0.0 for one in companions]

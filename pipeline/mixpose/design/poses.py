"""Poses at which a planned system is judged: positions in a box, turns around a first pose."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session import Session
from mixpose.simulation.central_pose import central_pose, pivot_of

ALL_TURNS = 180.0
TURN_AROUND_START = 20.0  # degrees, if the session gives the body's orientation


def spread_poses(
    session: Session,
    count: int,
    *,
    volume: Floats | None = None,
    turn_deg: float | None = None,
    seed: int = 0,
) -> Floats:
    """Return poses T_world_object (P, 4, 4) spread evenly over a volume; the first is its middle.

    Cameras must have a resolution.  The middle is the session's ``[start]``, or else where its
    sensors look together.  `volume` (3,) are the sides of the box, along the world's axes, that
    contains the body's middle; the default is twice the body's radius.  `turn_deg`, up to 180, is
    the largest angle from the orientation of the middle; the default is 20 around a ``[start]``,
    else 180.  Raises SessionError if no place is in view of a sensor.
    """
    centre = central_pose(session, seed)
    body = session.body
    sides = np.full(3, 2 * body.radius) if volume is None else np.asarray(volume)
    if turn_deg is None:
        turn_deg = ALL_TURNS if session.start is None else TURN_AROUND_START
    if not 0 <= turn_deg <= ALL_TURNS:
        raise SessionError(f"--turn: found {turn_deg:g}; allowed: degrees from 0 to 180")
    drawn = qmc.Halton(6, rng=np.random.default_rng(seed)).random(count)
    pivot = pivot_of(body)
    middle = centre[:3, :3] @ pivot + centre[:3, 3]
    positions = middle + (drawn[:, :3] - 0.5) * sides
    rotations = _turns(drawn[:, 3:], turn_deg) @ centre[:3, :3]
    poses = from_parts(rotations, positions - rotations @ pivot)
    poses[0] = centre
    return poses


def _turns(drawn: Floats, turn_deg: float) -> Floats:
    """Return evenly spread rotations (P, 3, 3) up to an angle, from numbers (P, 3) from 0 to 1."""
    if turn_deg >= ALL_TURNS:
        u, v, w = drawn[:, 0], 2 * np.pi * drawn[:, 1], 2 * np.pi * drawn[:, 2]
        a, b = np.sqrt(1 - u), np.sqrt(u)
        quaternions = np.array([a * np.sin(v), a * np.cos(v), b * np.sin(w), b * np.cos(w)]).T
        return np.asarray(Rotation.from_quat(quaternions).as_matrix())
    height, around = 2 * drawn[:, 0] - 1, 2 * np.pi * drawn[:, 1]
    across = np.sqrt(1 - height**2)
    axes = np.array([across * np.cos(around), across * np.sin(around), height]).T
    angles = np.radians(turn_deg) * np.cbrt(drawn[:, 2])
    return np.asarray(Rotation.from_rotvec(axes * angles[:, None]).as_matrix())

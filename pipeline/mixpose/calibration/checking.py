"""Whether an old calibration still holds, and which sensor was bumped.

A new calibration from the recording says by how much every sensor is off, relative to the others,
and how sure that is.  Moving all sensors together is no matter: what counts is each sensor against
the consensus of the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.calibration.result import Calibration
from mixpose.calibration.rig import Rig, centre_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse


@dataclass(frozen=True)
class Displacement:
    """How far one sensor is from where the old calibration has it."""

    name: str
    turn_deg: float  # against the consensus of the sensors, like the shift
    shift: float
    turn_deviation_deg: float
    shift_deviation: float
    residual_before: float  # sensor units
    residual_after: float  # of frames that are held back where there are enough
    moved: bool


def displacements(found: Calibration, rules: CalibrationRules) -> tuple[Displacement, ...]:
    """Compare a calibration with the one it began from."""
    G = _consensus(found.before, found.after)
    deviations = _deviations(found)
    told = []
    for index, name in enumerate(found.after.names):
        turn, shift = _apart(found.before, found.after, index, G)
        sd_turn, sd_shift = deviations[index]
        each = found.residuals[index]
        before, after = each.before, each.held if np.isfinite(each.held) else each.after
        worse = bool(np.isfinite(before) and before > rules.worse * max(after, 1e-12))
        far = turn > rules.moved * sd_turn or shift > rules.moved * sd_shift
        told.append(
            Displacement(name, turn, shift, sd_turn, sd_shift, before, after, worse and far)
        )
    return tuple(told)


def _poses(before: Rig, after: Rig, index: int) -> tuple[Floats, Floats] | None:
    """T_sensor_world of a sensor before and after; None of a range sensor."""
    old, new = (getattr(rig.sensors[index], "T_sensor_world", None) for rig in (before, after))
    return None if old is None or new is None else (old, new)


def _consensus(before: Rig, after: Rig) -> Floats:
    """The motion of the world (4, 4) after which most sensors stand where they stood.

    That of the sensor from which the others differ least: the bumped ones are outvoted.
    """
    count = len(before.names)
    poses = [_poses(before, after, k) for k in range(count)]
    motions = [inverse(pair[0]) @ pair[1] for pair in poses if pair is not None]
    if len(motions) < 3:  # of two, none is outvoted: the first is believed
        return motions[0] if motions else _from_places(before, after)
    worth = []
    for G in motions:
        apart = [_apart(before, after, k, G) for k in range(count)]
        worth.append((np.median([t for t, _ in apart]), np.median([s for _, s in apart])))
    return motions[int(np.lexsort(np.array(worth).T[::-1])[0])]


def _from_places(before: Rig, after: Rig) -> Floats:
    """The best motion between range sensors."""
    a = np.array([centre_of(s) for s in after.sensors])
    b = np.array([centre_of(s) for s in before.sensors])
    if len(a) < 3:
        return from_parts(np.eye(3), (b - a).mean(axis=0))
    R, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    matrix = R.as_matrix()
    return from_parts(matrix, b.mean(axis=0) - matrix @ a.mean(axis=0))


def _apart(before: Rig, after: Rig, index: int, G: Floats) -> tuple[float, float]:
    """Turn in degrees and shift of a sensor, the new world moved into the old one by G."""
    poses = _poses(before, after, index)
    if poses is None:
        place = G[:3, :3] @ centre_of(after.sensors[index]) + G[:3, 3]
        return 0.0, float(np.linalg.norm(place - centre_of(before.sensors[index])))
    old, moved = poses[0], poses[1] @ inverse(G)
    turn = Rotation.from_matrix(moved[:3, :3] @ old[:3, :3].T).magnitude()
    shift = np.linalg.norm(inverse(moved)[:3, 3] - inverse(old)[:3, 3])
    return float(np.degrees(turn)), float(shift)


def _deviations(found: Calibration) -> list[tuple[float, float]]:
    """Standard deviations of turn in degrees and shift of each sensor; those held have the least.

    A sensor that is held is as uncertain against the others as they are against it.
    """
    own: dict[int, tuple[float, float]] = {}
    for block in found.blocks:
        if block.kind in ("pose", "position") and block.sensor is not None:
            part = found.deviations[block.place]
            turn = float(np.degrees(np.sqrt((part[3:] ** 2).sum()))) if len(part) > 3 else 0.0
            own[block.sensor] = (turn, float(np.sqrt((part[:3] ** 2).sum())))
    least = (
        min((t for t, _ in own.values()), default=np.inf),
        min((s for _, s in own.values()), default=np.inf),
    )
    return [own.get(index, least) for index in range(len(found.after.names))]

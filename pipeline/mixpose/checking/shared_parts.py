"""Bodies of a session that could be taken for each other."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from mixpose.body import Body, LookAlike, congruent_parts
from mixpose.checking.lookalikes import noise_of
from mixpose.checking.typical import typical_poses
from mixpose.session import Session

_NOISES = 3.0  # standard deviations that markers may be off each other
_LEAST = 0.01  # of the smaller body's radius: nearer than this they are the same


def shared_part_warnings(session: Session) -> list[str]:
    """Pairs of bodies, or parts of them, that are congruent within the noise, with their markers.

    The largest part of each pair is named.
    """
    warnings = list[str]()
    if len(session.objects) < 2:
        return warnings
    noise = _noise_length(session)
    for one, other in combinations([each.body for each in session.objects], 2):
        parts = congruent_parts(one, other, _tolerance(one, other, noise))
        if parts:
            warnings.append(_text(parts[0], session.unit))
    return warnings


def _tolerance(one: Body, other: Body, noise: float) -> float:
    least = _LEAST * min(one.radius, other.radius)
    return max(least, _NOISES * noise, one.spread, other.spread)


def _noise_length(session: Session) -> float:
    """What markers err by in the world, where the bodies are about: the best of the sensors."""
    lengths = []
    for setup in session.sensors:
        if setup.sensor.dimension == 1:
            lengths.append(noise_of(setup))
            continue
        if any(s.sensor.dimension == 2 and s.resolution is None for s in session.sensors):
            continue
        for T in typical_poses(session, 1)[:1]:
            _, J, seen = setup.sensor.linearise(session.body.means @ T[:3, :3].T + T[:3, 3])
            if seen.all():
                lengths.append(noise_of(setup) / max(float(np.linalg.norm(J[0], 2)), 1e-12))
    return min(lengths, default=0.0)


def _text(part: LookAlike, unit: str) -> str:
    one, other = part.body, part.other
    pairs = ", ".join(f"{i} like {j}" for i, j in zip(part.features, part.partners, strict=True))
    whole = len(part.features) == len(one) == len(other)
    if whole:
        return (
            f"the bodies {one.name!r} and {other.name!r} are congruent to {part.off:.2g} {unit} "
            f"(markers {pairs}): nothing tells them apart; give one [[object]] with count, or move "
            "a marker"
        )
    return (
        f"{len(part.features)} markers of {one.name!r} lie like {len(part.features)} of "
        f"{other.name!r} to "
        f"{part.off:.2g} {unit} ({pairs}): where the others are hidden the one may be the other; "
        "expect ambiguous frames, or move a marker"
    )

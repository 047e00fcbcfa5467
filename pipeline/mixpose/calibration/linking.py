"""Where sensors stand to each other, from where each of them sees the body.

Every frame that two sensors see gives votes for their relative pose, one for each combination of
their hypotheses and of the body's symmetries; only the right ones agree over frames.  Sensors
are then linked along the pairs with most frames in agreement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import Hypotheses
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import from_parts, inverse, rotation_angle_deg

Seen: TypeAlias = Sequence[Mapping[int, Hypotheses]]
"""By frame, then by sensor; only those that have a pose."""


class Votes(NamedTuple):
    """What one frame says of a relative pose."""

    motions: Floats  # (..., 4, 4)
    distance: float  # to the body: translations err by a share of it


class Link(NamedTuple):
    """The relative pose of two sensors."""

    T_a_b: Floats  # (4, 4)
    frames: int  # that agree on it


def agreed(told: Sequence[Votes], T_expected: Floats, rules: CalibrationRules) -> Link | None:
    """The motion that votes of most frames agree on.

    Parameters
    ----------
    told : sequence of Votes
        One for each frame.
    T_expected : (4, 4) array
        Decides between motions with as many frames.
    """
    if not told:
        return None
    parts = [each.motions.reshape(-1, 4, 4) for each in told]
    votes, counts = np.concatenate(parts), [len(part) for part in parts]
    frame = np.repeat(np.arange(len(told)), counts)
    away = np.repeat([rules.shift * each.distance for each in told], counts)
    near = np.argsort(rotation_angle_deg(T_expected, votes), kind="stable")
    half = rules.seeds // 2
    spread = np.linspace(0, len(votes) - 1, min(half, len(votes))).astype(int)
    best, best_score = 0, (-1.0, 0.0)
    for seed in np.unique(np.concatenate([near[:half], spread])):
        inside, distance = _inside(votes[seed], votes, away, rules)
        # the mean distance decides between middles of one cluster
        score = (float(len(np.unique(frame[inside]))), -float(distance[inside].mean()))
        if score > best_score:
            best, best_score = int(seed), score
    T = votes[best]
    for _ in range(3):
        inside, distance = _inside(T, votes, away, rules)
        chosen = _nearest_of_each(frame, distance, inside)
        # the mean rotation and the median shift
        R = Rotation.from_matrix(votes[chosen, :3, :3]).mean().as_matrix()
        T = from_parts(R, np.median(votes[chosen, :3, 3], axis=0))
    return Link(T, len(chosen))


def _inside(T: Floats, votes: Floats, away: Floats, rules: CalibrationRules) -> tuple[Mask, Floats]:
    turn = rotation_angle_deg(T, votes) / rules.turn_deg
    shift = np.linalg.norm(votes[:, :3, 3] - T[:3, 3], axis=1) / away
    distance = np.maximum(turn, shift)
    return distance < 1, distance


def _nearest_of_each(frame: Indices, distance: Floats, inside: Mask) -> Indices:
    """Of each frame the vote that is nearest, among those inside."""
    order = np.flatnonzero(inside)
    order = order[np.argsort(distance[order], kind="stable")]
    _, first = np.unique(frame[order], return_index=True)
    return np.asarray(order[first])


def _pair_link(
    common: Seen, a: int, b: int, symmetries: Floats, T_expected: Floats, rules: CalibrationRules
) -> Link | None:
    """Where sensor b stands to sensor a, by frames in which both know a pose."""
    told = []
    for each in common:
        T_a, T_b = each[a].poses, each[b].poses
        motions = T_a[:, None, None] @ symmetries[None, None] @ inverse(T_b)[None, :, None]
        reach = float(np.linalg.norm(T_a[0][:3, 3]) + np.linalg.norm(T_b[0][:3, 3])) / 2
        told.append(Votes(motions, reach))
    return agreed(told, T_expected, rules)


def link_all(
    seen: Seen,
    placed: Mapping[int, Floats],
    wanted: Sequence[int],
    expected: Mapping[int, Floats],
    symmetries: Floats,
    rules: CalibrationRules,
) -> tuple[dict[int, Floats], dict[int, tuple[int, int]]]:
    """Place sensors one after the other, along the strongest links.

    Parameters
    ----------
    placed : mapping of int to (4, 4) array
        T_sensor_world of sensors that stay where they are.
    wanted : sequence of int
        Sensors to place.
    expected : mapping of int to (4, 4) array
        T_sensor_world as the session has it.
    symmetries : (S, 4, 4) array

    Returns
    -------
    dict of int to (4, 4) array
        T_sensor_world of all that are linked.
    dict of int to (int, int)
        Through which sensor each was linked, and in how many frames the two agree.
    """
    T, through = dict(placed), {}
    left = [one for one in wanted if one not in T]
    links: dict[tuple[int, int], Link | None] = {}
    while left:
        best: tuple[Link, int, int] | None = None
        for b in left:
            for a in sorted(T):
                if (b, a) not in links:
                    common = [each for each in seen if a in each and b in each]
                    T_expected = expected[b] @ inverse(expected[a])
                    link = _pair_link(common, b, a, symmetries, T_expected, rules)
                    # fewer frames must agree only where hardly any are there
                    least = max(min(rules.least_link, len(common)), 1)
                    links[b, a] = link if link is not None and link.frames >= least else None
                link = links[b, a]
                if link is not None and (best is None or link.frames > best[0].frames):
                    best = (link, b, a)
        if best is None:
            break
        link, b, a = best
        T[b] = link.T_a_b @ T[a]
        through[b] = (a, link.frames)
        left.remove(b)
    return T, through

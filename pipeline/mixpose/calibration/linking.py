"""Where sensors stand to each other, from where each of them sees the body.

Every frame that two sensors see gives votes for their relative pose, one for each combination of
their hypotheses and of the body's symmetries; only the right ones agree over frames.  Sensors
are then linked along the pairs with most frames in agreement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.calibration.alone import Hypotheses
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats, Mask
from mixpose.rigid import from_parts, inverse, rotation_angle_deg

Ints: TypeAlias = NDArray[np.intp]
Seen: TypeAlias = Sequence[Mapping[int, Hypotheses]]
"""By frame, then by sensor."""


@dataclass(frozen=True, eq=False)
class Link:
    """The relative pose of two sensors."""

    T_a_b: Floats  # (4, 4)
    frames: int  # that agree on it


def agreed(
    votes: Floats, frame: Ints, away: Floats, T_expected: Floats, rules: CalibrationRules
) -> Link | None:
    """The motion that votes of most frames agree on.

    Parameters
    ----------
    votes : (V, 4, 4) array
    frame : (V,) array
        The frame that each comes from.
    away : (V,) array
        Length by which a vote's translation may err at most.
    T_expected : (4, 4) array
        Decides between motions with as many frames.
    """
    if not len(votes):
        return None
    near = np.argsort(rotation_angle_deg(T_expected, votes), kind="stable")
    half = rules.seeds // 2
    seeds = np.unique(np.concatenate([near[:half], _spread(len(votes), half)]))
    best, best_score = None, (-1.0, 0.0)
    for seed in seeds:
        inside, distance = _inside(votes[seed], votes, away, rules)
        count = float(len(np.unique(frame[inside])))
        # the mean distance decides between middles of one cluster
        score = (count, -float(distance[inside].mean()))
        if score > best_score:
            best, best_score = seed, score
    assert best is not None
    T = votes[best]
    for _ in range(3):
        inside, distance = _inside(T, votes, away, rules)
        chosen = _nearest_of_each(frame, distance, inside)
        T = mean_motion(votes[chosen])
    return Link(T, len(chosen))


def _spread(count: int, most: int) -> Ints:
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def _inside(T: Floats, votes: Floats, away: Floats, rules: CalibrationRules) -> tuple[Mask, Floats]:
    turn = rotation_angle_deg(T, votes) / rules.turn_deg
    shift = np.linalg.norm(votes[:, :3, 3] - T[:3, 3], axis=1) / away
    distance = np.maximum(turn, shift)
    return distance < 1, distance


def _nearest_of_each(frame: Ints, distance: Floats, inside: Mask) -> Ints:
    """Of each frame the vote that is nearest, among those inside."""
    order = np.flatnonzero(inside)
    order = order[np.argsort(distance[order], kind="stable")]
    _, first = np.unique(frame[order], return_index=True)
    return np.asarray(order[first])


def mean_motion(votes: Floats) -> Floats:
    """Mean rotation and median shift of motions (V, 4, 4)."""
    rotation = Rotation.from_matrix(votes[:, :3, :3]).mean().as_matrix()
    return from_parts(rotation, np.median(votes[:, :3, 3], axis=0))


def pair_link(
    seen: Seen, a: int, b: int, symmetries: Floats, T_expected: Floats, rules: CalibrationRules
) -> Link | None:
    """Where sensor b stands to sensor a."""
    votes, frame, away = [], [], []
    for k, each in enumerate(seen):
        if not _both_know(each, a, b):
            continue
        T_a, T_b = each[a].poses, each[b].poses
        at = T_a[:, None, None] @ symmetries[None, None] @ inverse(T_b)[None, :, None]
        flat = at.reshape(-1, 4, 4)
        reach = float(np.linalg.norm(T_a[0][:3, 3]) + np.linalg.norm(T_b[0][:3, 3])) / 2
        votes.append(flat)
        frame.append(np.full(len(flat), k))
        away.append(np.full(len(flat), rules.shift * reach))
    if not votes:
        return None
    parts = np.concatenate(votes), np.concatenate(frame), np.concatenate(away)
    return agreed(*parts, T_expected, rules)


def _both_know(each: Mapping[int, Hypotheses], a: int, b: int) -> bool:
    return a in each and b in each and len(each[a].poses) > 0 and len(each[b].poses) > 0


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
        best: tuple[int, int, int] | None = None
        for b in left:
            for a in sorted(T):
                if (b, a) not in links:
                    T_expected = expected[b] @ inverse(expected[a])
                    links[b, a] = pair_link(seen, b, a, symmetries, T_expected, rules)
                link = links[b, a]
                if link is None or link.frames < least_frames(seen, a, b, rules):
                    continue
                if best is None or link.frames > best[0]:
                    best = (link.frames, b, a)
        if best is None:
            break
        frames, b, a = best
        link = links[b, a]
        assert link is not None
        T[b] = link.T_a_b @ T[a]
        through[b] = (a, frames)
        left.remove(b)
    return T, through


def least_frames(seen: Seen, a: int, b: int, rules: CalibrationRules) -> int:
    """Frames that must agree: fewer only where hardly any are there."""
    common = sum(_both_know(each, a, b) for each in seen)
    return max(min(rules.least_link, common), 1)

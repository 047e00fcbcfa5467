"""What does not move: points that are at one place of the world in most frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from mixpose.learning.points import Cloud
from mixpose.learning.rules import LearningRules
from mixpose.records import Floats, Indices


def gathered_places(
    points: Floats, reach: Floats, frame: Indices, least: float, rules: LearningRules
) -> list[tuple[Floats, Indices]]:
    """Places at which points of many frames are, those of most frames first.

    Parameters
    ----------
    points : (n, 3) array
    reach : (n,) array
        How far off a point may be, standard deviations times the gate.
    frame : (n,) array
        That a point is of; of frames that tell the same, one number.
    least : float
        Frames below which a place is none.

    Returns
    -------
    list of (place (3,), indices of the points there)
        At most one of each frame, the nearest; those within three gates are left out of later ones.
    """
    found: list[tuple[Floats, Indices]] = []
    if len(points) < least:
        return found
    typical = float(np.median(reach))
    tree = cKDTree(points)
    near = tree.query_ball_point(points, 2 * typical)
    counts = np.array([len(np.unique(frame[each])) for each in near])
    left = np.ones(len(points), dtype=np.bool_)
    for k in np.argsort(-counts, kind="stable"):
        if counts[k] < least:
            break
        if not left[k]:
            continue
        place = points[k]
        for _ in range(3):
            there = np.array(tree.query_ball_point(place, 3 * typical), dtype=np.intp)
            away = np.linalg.norm(points[there] - place, axis=1)
            inside = there[away <= np.maximum(reach[there], typical)]
            if not len(inside):
                break
            weight = 1 / reach[inside] ** 2
            place = weight @ points[inside] / weight.sum()
        away = np.linalg.norm(points[there] - place, axis=1)
        left[there] = False
        left[k] = False
        near_by = len(np.unique(frame[there]))
        order = np.argsort(away, kind="stable")
        chosen = there[order][away[order] <= np.maximum(reach[there[order]], typical)]
        _, first = np.unique(frame[chosen], return_index=True)
        chosen = chosen[np.sort(first)]
        if len(chosen) >= max(least, rules.gathered * near_by):
            found.append((place, chosen))
    return found


def without_still(
    clouds: Sequence[Cloud], rules: LearningRules
) -> tuple[list[Cloud], list[Floats]]:
    """Clouds without what stands still, and where that is.

    A body that rests in most of the frames is lost from these alone.
    """
    points = np.concatenate([cloud.points for cloud in clouds])
    reach = rules.gate * np.concatenate([cloud.reach for cloud in clouds])
    frame = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    index = np.concatenate([np.arange(len(cloud)) for cloud in clouds])
    filled = sum(len(cloud) > 0 for cloud in clouds)
    least = max(rules.still_share * filled, rules.least_frames)
    places, left = list[Floats](), list(clouds)
    taken: list[list[int]] = [[] for _ in clouds]
    for place, chosen in gathered_places(points, reach, frame, least, rules):
        places.append(place)
        for n in chosen.tolist():
            taken[frame[n]].append(int(index[n]))
    for k, rows in enumerate(taken):
        if rows:
            left[k] = clouds[k].without(clouds[k].detections[rows])
    return left, places

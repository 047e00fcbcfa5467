"""Test whether one of two poses is the mirror image of the other, and which one is the body.

A plane mirror shows a body that looks like its mirror image, as a flat one does, a second time.
With the improper motion that maps the body onto itself, the motion from one pose to the other is
improper, too: in general it turns about an axis m by an angle φ, reflects along m, and shifts
across m by g (two coordinates).  Of a mirror image φ and g are 0.  Of two bodies φ is anywhere
within 2π and g up to their distance, so that well known poses tell the two cases apart.  The body
is nearer to every camera than its image, and all of it is on this side of the mirror.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from mixpose.body import Body, like_features, mirror_image, reflection, thickness, tolerance_of
from mixpose.body.symmetry import motions
from mixpose.judgement import ScoredPose
from mixpose.records import Floats
from mixpose.rigid import inverse, perturb, transform
from mixpose.tracking.frame import Frame, Setup

MIRRORED = "it shows the body's mirror image"
IN_A_MIRROR = "a flat body looks the same in a mirror, and the session says that there are some"

_STEP = 1e-6  # of differences, radii and radians


def is_flat(data: Setup) -> bool:
    """Test whether the body is flat and a turn brings it, with its faces, onto its mirror image."""
    body, alike = data.body, data.rules.look_alikes.alike
    return body.is_exact and thickness(body) < alike and bool(_improper_symmetries(body, alike))


def mirror_odds(data: Frame, first: ScoredPose, second: ScoredPose) -> tuple[float, bool]:
    """Return log odds of a mirror between two poses, and whether `first` is the body.

    A second body is as likely as a mirror, before the poses are compared.
    """
    a, b, images, body = first.T_world_object, second.T_world_object, [], data.body
    x, rules = transform(a, body.means), data.rules.look_alikes
    cameras = [view.sensor for view in data.views if view.sensor.dimension == 2]
    for E in _improper_symmetries(body, rules.alike):
        y = transform(b @ E @ inverse(a), x)
        gap = (x - y).mean(axis=0)
        if ((x - y) @ gap).min() <= 0:  # no body reaches through a mirror, unlike other tilts
            continue
        middle = ((x + y) / 2).mean(axis=0, keepdims=True)
        sides = [float(camera.towards(middle)[0] @ gap) for camera in cameras]
        sides = [side for side in sides if side]  # images of clouds have no viewpoint
        if sides and (min(sides) > 0 or max(sides) < 0):
            images.append((_log_odds(first, second, E, body, rules.plane), sides[0] > 0))
    if not images:
        return -math.inf, True
    odds = np.array([log_odds for log_odds, _ in images])
    return float(np.logaddexp.reduce(odds) - math.log(len(odds))), images[int(odds.argmax())][1]


@lru_cache(maxsize=64)
def _improper_symmetries(body: Body, alike: float) -> tuple[Floats, ...]:
    """Return improper motions (4, 4) that map the body onto itself, up to `alike` of its radius."""
    everything = frozenset(range(len(body)))
    image, M = mirror_image(body, everything), reflection(body.means)
    # each feature of a flat body maps onto itself; a normal would point to the other side
    if thickness(body) < alike and body.normals is None:
        onto = [*motions(body.means, image.means[None])]
    else:
        parts = like_features(image, everything, body, tolerance_of(body, body, alike))
        onto = [part.T_body_other for part in parts if len(part.features) == len(body)]
    return tuple(inverse(T @ S) @ M for T in onto for S in body.symmetries)


def _log_odds(pose: ScoredPose, image: ScoredPose, E: Floats, body: Body, off: float) -> float:
    """Return log odds of a mirror by two poses; E (4, 4) maps the body onto itself.

    The mirror is `off` a plane, in radii and radians.
    """
    steps = _STEP * np.diag(np.repeat([body.radius, 1.0], 3))
    a, b = pose.T_world_object[None], image.T_world_object[None]
    resting = np.repeat(a, 6, axis=0), np.repeat(b, 6, axis=0)
    first = np.concatenate([a, perturb(a, steps), resting[0]])
    second = np.concatenate([b, resting[1], perturb(b, steps)])
    seen, apart = _turn_and_shift(first, second, E, body.means.mean(axis=0))
    J = (seen[1:] - seen[0]).T / np.tile(steps.diagonal(), 2)
    C = J[:, :6] @ pose.covariance @ J[:, :6].T + J[:, 6:] @ image.covariance @ J[:, 6:].T
    C += np.diag(np.square(off * np.array([1.0, body.radius, body.radius])))
    squared = float(seen[0] @ np.linalg.solve(C, seen[0]))
    log_density = -0.5 * (squared + float(np.linalg.slogdet(2 * np.pi * C)[1]))
    return log_density + math.log(2 * math.pi * math.pi * apart**2)


def _turn_and_shift(a: Floats, b: Floats, E: Floats, centre: Floats) -> tuple[Floats, float]:
    """Return the turn and the shift (K, 3) from poses a to b (K, 4, 4), beside a reflection.

    Also return the distance between the two places of the body.
    """
    Q = b @ E @ inverse(a)
    A, x = Q[:, :3, :3], transform(a, centre[None])
    shifts = (transform(Q, x) - x)[:, 0]
    axis = np.linalg.eigh(A + A.swapaxes(1, 2))[1][:, :, 0]
    axis *= np.sign(axis @ shifts[0])[:, None]
    around = np.stack([A[:, 2, 1] - A[:, 1, 2], A[:, 0, 2] - A[:, 2, 0], A[:, 1, 0] - A[:, 0, 1]])
    turn = np.arctan2(np.vecdot(axis, around.T), np.trace(A, axis1=1, axis2=2) + 1)
    shift = shifts - np.vecdot(axis, shifts)[:, None] * axis
    across = np.linalg.svd(axis[:1])[2][1:]
    return np.column_stack([turn, shift @ across.T]), float(np.linalg.norm(shifts[0]))

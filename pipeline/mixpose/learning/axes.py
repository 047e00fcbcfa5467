"""Choose the axes of a learnt body: principal, by some of its markers, or of an older body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np

from mixpose.body import congruent_parts, tolerance_of
from mixpose.errors import SessionError
from mixpose.learning.adjusting import LearntBody
from mixpose.learning.shapes import body_of
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse

ALIKE = 0.1
"""Of the radius: allowed offset of markers of an older body, as of one measured with a ruler."""
_SAME = 0.6  # of the markers of the smaller body: share that both must have
_SYMMETRIC = 1e-3  # of the cubed size: skew that is needed to choose the direction of an axis


def in_principal_axes(learnt: LearntBody) -> LearntBody:
    """Return the body about the mean of its markers, x along its longest extent, z its shortest.

    x and y point to the side on which markers lie farther out; markers are numbered along x.
    """
    centre = learnt.points.mean(axis=0)
    centred = learnt.points - centre
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].T
    size = float(np.sqrt((centred**2).sum(axis=1).mean()))
    for k in (0, 1):
        along = centred @ axes[k]
        skew = float((along**3).mean())
        if abs(skew) < _SYMMETRIC * size**3:
            skew = float(along[np.argmax(np.abs(along).round(9))])
        axes[k] *= 1.0 if skew >= 0 else -1.0
    axes[2] = np.cross(axes[0], axes[1])
    order = np.argsort(-(centred @ axes[0]), kind="stable")
    names = tuple(str(k + 1) for k in range(len(order)))
    return replace(learnt.within(inverse(from_parts(axes.T, centre)), order), names=names)


def in_marker_axes(learnt: LearntBody, words: str) -> LearntBody:
    """Return the body with its origin in a marker, x to a second one and a third in the x-y plane.

    `words` names them: ``O,X,Y``.  Raises a SessionError if they are not three that span a plane.
    """
    wanted = [word.strip() for word in words.split(",")]
    if len(set(wanted)) != 3 or len(wanted) != 3 or not set(wanted) <= set(learnt.names):
        raise SessionError(
            f"--axes {words}: allowed: ORIGIN,X,Y, three of the markers {', '.join(learnt.names)}"
        )
    o, x, y = (learnt.points[learnt.names.index(word)] for word in wanted)
    across = np.cross(x - o, y - o)
    if np.linalg.norm(across) < 0.02 * np.linalg.norm(x - o) * np.linalg.norm(y - o):
        raise SessionError(
            f"--axes {words}: the three markers lie on a line; allowed: three that span a plane"
        )
    first, third = (v / np.linalg.norm(v) for v in (x - o, across))
    R = np.array([first, np.cross(third, first), third])
    return learnt.within(from_parts(R, -R @ o))


class Alignment(NamedTuple):
    """A learnt body in the axes of an older one."""

    body: LearntBody
    shared: int  # number of markers that both have
    max_distance: float  # between these markers
    other_ways: int  # other ways to lay it on the older one, with as many markers


def in_axes_of(learnt: LearntBody, points: Floats, names: Sequence[str]) -> Alignment | None:
    """Return the body in the axes, order and names of an older one (M, 3); None for another body.

    `names` is empty if markers of the older body have none.
    """
    old, new = body_of("old", points), body_of("new", learnt.points)
    parts = congruent_parts(old, new, tolerance_of(old, new, ALIKE))
    least = max(3, int(np.ceil(_SAME * min(len(points), len(learnt.points)))))
    if not parts or len(parts[0].features) < least:
        return None
    best = parts[0]
    partner = dict(zip(best.partners, best.features, strict=True))
    old_names = names or [str(k + 1) for k in range(len(points))]
    order = sorted(range(len(learnt.points)), key=lambda k: (partner.get(k, len(points)), k))
    aligned = learnt.within(best.T_body_other, np.array(order, dtype=np.intp))
    # markers that are new get the next number that is no name of the older body
    unused = (str(number) for number in count(len(old_names) + 1) if str(number) not in old_names)
    new_names = tuple(old_names[partner[k]] if k in partner else next(unused) for k in order)
    same = [part for part in parts[1:] if len(part.features) == len(best.features)]
    return Alignment(replace(aligned, names=new_names), len(best.features), best.off, len(same))

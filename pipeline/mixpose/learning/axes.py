"""The frame of a learnt body: its principal axes, some of its markers, or an older body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np

from mixpose.body import congruent_parts, tolerance_of
from mixpose.errors import SessionError
from mixpose.learning.adjusting import Learnt
from mixpose.learning.shapes import body_of
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse

ALIKE = 0.1
"""Of the radius: how far markers of an older body may be off, as where a ruler measured them."""
_SAME = 0.6  # of the markers of the smaller body that must be alike in both
_SYMMETRIC = 1e-3  # of the cubed size: less skew tells no direction of an axis


def in_principal_axes(learnt: Learnt) -> Learnt:
    """The body about the middle of its markers, x along its longest extent, z its shortest.

    The side of x and y is that to which markers reach farther; markers are numbered along x.
    """
    middle = learnt.points.mean(axis=0)
    away = learnt.points - middle
    axes = np.linalg.eigh(away.T @ away)[1][:, ::-1].T
    size = float(np.sqrt((away**2).sum(axis=1).mean()))
    for k in (0, 1):
        along = away @ axes[k]
        skew = float((along**3).mean())
        if abs(skew) < _SYMMETRIC * size**3:
            skew = float(along[np.argmax(np.abs(along).round(9))])
        axes[k] *= 1.0 if skew >= 0 else -1.0
    axes[2] = np.cross(axes[0], axes[1])
    order = np.argsort(-(away @ axes[0]), kind="stable")
    names = tuple(str(k + 1) for k in range(len(order)))
    return replace(learnt.within(inverse(from_parts(axes.T, middle)), order), names=names)


def by_markers(learnt: Learnt, words: str) -> Learnt:
    """The body with the origin in a marker, x to a second one, and a third in the x-y plane.

    They are named ``O,X,Y``.  Raises a SessionError if these are no three that span a plane.
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


class Likeness(NamedTuple):
    """A learnt body beside an older one."""

    learnt: Learnt
    shared: int  # markers that both have
    off: float  # the farthest of them apart
    others: int  # other ways to lay it on the older one, with as many markers


def like(learnt: Learnt, points: Floats, names: Sequence[str]) -> Likeness | None:
    """The body in the frame, order and names of an older one (M, 3); None where it is another.

    Names are empty where markers of the older body have none.
    """
    old, new = body_of("old", points), body_of("new", learnt.points)
    parts = congruent_parts(old, new, tolerance_of(old, new, ALIKE))
    least = max(3, int(np.ceil(_SAME * min(len(points), len(learnt.points)))))
    if not parts or len(parts[0].features) < least:
        return None
    best = parts[0]
    partner = dict(zip(best.partners, best.features, strict=True))
    known = names or [str(k + 1) for k in range(len(points))]
    order = sorted(range(len(learnt.points)), key=lambda k: (partner.get(k, len(points)), k))
    found = learnt.within(best.T_body_other, np.array(order, dtype=np.intp))
    # names of partners, else the next number that is no name
    others = (str(number) for number in count(len(known) + 1) if str(number) not in known)
    called = tuple(known[partner[k]] if k in partner else next(others) for k in order)
    same = [part for part in parts[1:] if len(part.features) == len(best.features)]
    return Likeness(replace(found, names=called), len(best.features), best.off, len(same))

"""Poses that may be another body, or another way up: all that is met is a part that both have.

A body of which three markers are met looks like every body that has three markers in the same
places.  Where such another one of the session is not surely somewhere else, its pose there is a
rival: if that explains the frame about as well, the body is in doubt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from mixpose.body import Body, SharedPart, shared_parts
from mixpose.judgement import Judged
from mixpose.tracking.explain import Explanation, explain_by
from mixpose.tracking.tracked_body import TrackedBody


def may_be_another(
    k: int,
    best: Judged,
    members: Sequence[TrackedBody],
    found: Mapping[int, Explanation],
    elsewhere: Sequence[bool],
    alike: float,
) -> bool:
    """Whether a pose of member k might as well be one of another body, or another of its own.

    Parameters
    ----------
    k : int
    best : Judged
    members : sequence of TrackedBody
    found : mapping of int to Explanation
        Of the frame as it is left for each.
    elsewhere : sequence of bool
        Which members are surely where they are.
    alike : float
        How far markers of two bodies may be off each other, of the smaller one's radius; at least
        as far as either gives way.
    """
    met = {int(i) for one in best.associations for i in one.features[one.shares > 0]}
    body = members[k].body
    for j, other in enumerate(members):
        theirs = other.body
        # a body's own markers may repeat themselves: then it may be turned another way
        if j != k and (theirs is body or elsewhere[j]):
            continue
        limit = best.log_evidence + float(np.log(other.rules.acceptance.rival))
        for part in parts_of(body, theirs, alike):
            if not met <= set(part.own):
                continue
            there = replace(best, T_world_object=best.T_world_object @ part.T_body_other)
            seen = replace(found[j].frame, views=found[k].frame.views, begun=None)
            rival = explain_by(other, seen, found[k].left, [there], fitted=True)
            if rival.ranked and rival.evidence > limit:
                return True
    return False


@lru_cache(maxsize=4096)
def parts_of(body: Body, other: Body, alike: float) -> tuple[SharedPart, ...]:
    """Parts that two bodies have in common."""
    tolerance = max(alike * min(body.radius, other.radius), body.spread, other.spread)
    return tuple(shared_parts(body.means, other.means, tolerance))

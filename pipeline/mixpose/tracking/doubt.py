"""Poses that may be another body, or another way up: all that is met is a part that both have.

A body of which three markers are met looks like every body that has three markers in the same
places.  Where such another one of the session is not surely somewhere else, its pose there is a
rival: if that explains the frame about as well, the body is in doubt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mixpose.body import like_features, tolerance_of
from mixpose.judgement import ScoredPose
from mixpose.tracking.explain import Explanation, explain_by
from mixpose.tracking.proposers import met_features
from mixpose.tracking.tracked_body import TrackedBody


def may_be_another(
    k: int,
    best: ScoredPose,
    members: Sequence[TrackedBody],
    found: Mapping[int, Explanation],
    elsewhere: Sequence[bool],
) -> str:
    """Why a pose of member k might as well be one of another body, or another of its own.

    Empty where it might not.

    Parameters
    ----------
    k : int
    best : ScoredPose
    members : sequence of TrackedBody
    found : mapping of int to Explanation
        Of the frame as it is left for each.
    elsewhere : sequence of bool
        Which members are surely where they are.
    """
    met, body = met_features(best), members[k].body
    for j, other in enumerate(members):
        theirs = other.body
        # a body's own markers may repeat themselves: then it may be turned another way
        if j != k and (theirs is body or elsewhere[j]):
            continue
        limit = best.log_evidence + float(np.log(other.rules.acceptance.rival))
        tolerance = tolerance_of(body, theirs, other.rules.look_alikes.alike)
        for part in like_features(body, met, theirs, tolerance):
            if len(part.features) < len(met):
                continue
            there = replace(best, T_world_object=best.T_world_object @ part.T_body_other)
            seen = replace(found[j].frame, views=found[k].frame.views, begun=None)
            rival = explain_by(other, seen, found[k].left, [there], fitted=True)
            if rival.ranked and rival.evidence > limit:
                return part.reason
    return ""

"""Whether a body was told from things that have markers alike.

Three markers in space are met by every thing that has three in the same places.  A body of more,
alone in its session, is known once others of it are met, and stays so while it is followed.

To one camera another thing may look like the body by chance.  As it moves as one, it does so for
several frames, and what the track expects then tells nothing.
"""

from __future__ import annotations

import numpy as np

from mixpose.judgement import Judged
from mixpose.tracking.likelihood import FrameData

TRIANGLE = "three markers are met, which other things may have alike"
ALONE = "one sensor of several meets the body, which none of its frames was sure of by itself"

_CORNERS = 3


def is_alone(data: FrameData, judged: Judged, sensors: int) -> bool:
    """Whether one of several sensors meets a body that no frame was sure of, as this one is not.

    Parameters
    ----------
    data : FrameData
    judged : Judged
    sensors : int
        With a frame, also those that saw nothing.
    """
    lonely = sensors > 1 and sum(one.met > 0 for one in judged.associations) == 1
    return lonely and is_from_doubt(data, judged)


def is_from_doubt(data: FrameData, judged: Judged) -> bool:
    """Whether a pose is sure for doubtful ones before it alone: it errs as they do."""
    if data.track.believed:
        return False
    gained = data.prior(judged.T_world_object).log_density - data.anywhere.log_density
    return judged.log_evidence - max(gained, 0.0) <= data.rules.acceptance.sure


def is_known(data: FrameData, judged: Judged) -> bool:
    """Whether a pose is the body's, by what it meets or by where it was expected."""
    if any(one.J.shape[1] == 1 for one in judged.associations):
        return True  # ranges are no markers in space
    sensors = np.zeros(len(data.body.nodes.points))
    for one in judged.associations:
        sensors[one.features[one.shares > 0]] += 1
    others = np.sort(sensors)[:-_CORNERS]
    # one sensor of several may meet a marker by chance
    if not len(others) or others.sum() >= max(len(data.views) / 2, 1):
        return True
    if not data.track.known or data.track.misses:
        return False
    return bool((data.prior(judged.T_world_object).spread < data.anywhere.spread).all())

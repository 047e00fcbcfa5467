"""From a prediction at once to narrow blurs, where detections bend the pose.

Spots that are cut, or run into another's, are off by a share of σ_ε: too little for the blur that a
fit begins with to leave them out, and enough to make the frame's noise seem larger than it is.
Where frames before tell how small it is, and where the body is to within that share, narrow blurs
hold on to the detections that agree.  They are most of every sensor's: where all of one sensor
are off, it is out of step or bumped, and what the others agree on is no better for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from mixpose.density import pooled, sums_of
from mixpose.judgement import Judged
from mixpose.tracking.likelihood import FrameData, Likelihood, Start


def narrowed(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """The predictions at narrow blurs, where residuals are larger than chance makes them."""
    if not judged.is_unlike or not likelihood.knows_detections:
        return
    if any(view.observation.cell is not None for view in data.views):
        return
    errors = data.rules.judgement.noise.errors
    variances = pooled(sums_of(data.noise), errors, errors.typical_degrees)
    largest = {view.name: errors.outlying**2 * v for view, v in zip(data.views, variances)}
    narrowest = errors.blur * float(np.sqrt(variances.max()))
    for one in data.predictions:
        for blur in [blur for blur in data.rules.proposals.blurs if blur > narrowest]:
            start = Start(one.T_world_object, one.uncertainty, blur=blur)
            found = likelihood.judge(likelihood.fit(start), start)
            if _agree(found, largest):
                yield Start(found.T_world_object)


def _agree(found: Judged, largest: Mapping[str, float]) -> bool:
    """Whether most features that a sensor meets are met as closely as noise lets them.

    `largest` has the squared offsets in σ_ε² that noise makes, by sensor.
    """
    for one in found.associations:
        offsets = one.squared[one.shares > 0]
        if np.count_nonzero(offsets > largest[one.name]) > len(offsets) / 2:
            return False
    return True

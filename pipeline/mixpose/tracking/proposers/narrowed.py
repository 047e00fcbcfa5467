"""From a prediction at once to narrow blurs, where detections bend the pose.

Spots that are cut, or run into another's, are off by a share of σ_ε: too little for the blur that a
fit begins with to leave them out.  Narrow blurs hold on to the detections that agree.
"""

from __future__ import annotations

from collections.abc import Iterable

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
            # where all of a sensor are off it is out of step, and the others no better for it
            off = ((one.squared[one.shares > 0], largest[one.name]) for one in found.associations)
            if not any(np.count_nonzero(each > most) > len(each) / 2 for each, most in off):
                yield Start(found.T_world_object)

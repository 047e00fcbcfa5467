"""From a prediction at once to narrow blurs, where detections bend the pose.

Spots that are cut, or run into another's, are off by a share of σ_ε: too little for the blur that a
fit begins with to leave them out.  Narrow blurs hold on to the detections that agree.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mixpose.judgement import ScoredPose
from mixpose.matching import pooled
from mixpose.tracking.likelihood import FrameData, Likelihood, Start


def narrowed(data: FrameData, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """The predictions at narrow blurs, where residuals are larger than chance makes them."""
    if not judged.is_unlike or not likelihood.knows_detections:
        return
    if any(view.observation.cell is not None for view in data.views):
        return
    errors = data.rules.judgement.noise.errors
    variances = pooled(data.noise, errors, errors.typical_degrees)
    largest = errors.outlying**2 * variances[:, None]
    narrowest = errors.blur * float(np.sqrt(variances.max()))
    for one in data.predictions:
        for blur in [blur for blur in data.rules.proposals.blurs if blur > narrowest]:
            start = Start(one.T_world_object, one.uncertainty, blur=blur)
            found = likelihood.judge(likelihood.fit(start), start)
            met = found.matches.shares > 0
            off = np.count_nonzero(met & (found.matches.squared > largest), axis=1)
            # where all of a sensor are off it is out of step, and the others no better for it
            if not (off > np.count_nonzero(met, axis=1) / 2).any():
                yield Start(found.T_world_object)

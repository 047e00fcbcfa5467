"""Several bodies that are fitted at once, as long as each is where it was expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mixpose.fit import fit_together
from mixpose.objective import SharedDensities, can_be_together, matched_objective
from mixpose.tracking.delays import is_timed
from mixpose.tracking.likelihood import Begun, FrameData


def begun_together(frames: Sequence[FrameData], shared: SharedDensities) -> list[FrameData]:
    """The frames of several bodies with what is climbed from their first predictions.

    Parameters
    ----------
    frames : sequence of FrameData
        Of the same sensors; what is not a body's own is out of its reach.
    shared : SharedDensities
        Of all that these sensors see.
    """
    begun = [
        Begun(matched_objective(one.views, one.body, one.sigmas, shared=shared), None)
        for one in frames
    ]
    some = [k for k, one in enumerate(frames) if _is_climbed(one)]
    if len(some) > 1:
        ascents = fit_together(
            [begun[k].objective for k in some],
            [frames[k].predictions[0].T_world_object for k in some],
            frames[some[0]].free,
            frames[some[0]].rules.fit,
        )
        for k, ascent in zip(some, ascents, strict=True):
            begun[k] = begun[k]._replace(ascent=ascent)
    return [
        one if is_timed(one.views) else replace(one, begun=each)
        for one, each in zip(frames, begun, strict=True)
    ]


def _is_climbed(data: FrameData) -> bool:
    """Whether a fit begins by climbing the matched objective from a prediction."""
    plain = data.options.objective == "matched" and not is_timed(data.views)
    return plain and bool(data.predictions) and can_be_together(data.body)

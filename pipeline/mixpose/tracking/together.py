"""Several bodies that are fitted at once, as long as each is where it was expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mixpose.fit import fit_together
from mixpose.judgement import Case, judge_together, nearest_alike
from mixpose.objective import SharedDensities, can_be_together, matched_objective
from mixpose.tracking.delays import is_timed
from mixpose.tracking.likelihood import Begun, FrameData, MatchedLikelihood, Start


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
        Begun(matched_objective(one.views, one.body, one.sigmas, shared=shared)) for one in frames
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
    together = [
        one if is_timed(one.views) else replace(one, begun=each)
        for one, each in zip(frames, begun, strict=True)
    ]
    return _judged(together, [k for k in some if begun[k].ascent is not None])


def _judged(frames: list[FrameData], some: Sequence[int]) -> list[FrameData]:
    """The frames, and of some of them the pose that the first prediction leads to, judged."""
    if len(some) < 2:
        return frames
    cases, fits = [], []
    for k in some:
        data, first = frames[k], frames[k].predictions[0]
        start = Start(first.T_world_object, first.uncertainty, first)
        fits.append(MatchedLikelihood(data).fit(start))
        T = nearest_alike(fits[-1].T_world_object, data.body, data.T_reference)
        cases.append(Case(data.finest, T, data.track.residuals, data.prior(T)))
    data = frames[some[0]]
    judged = judge_together(cases, data.free, data.rules.judgement)
    found = list(frames)
    for k, fit, one in zip(some, fits, judged, strict=True):
        begun = frames[k].begun
        assert begun is not None
        found[k] = replace(frames[k], begun=begun._replace(fit=fit, judged=one))
    return found


def _is_climbed(data: FrameData) -> bool:
    """Whether a fit begins by climbing the matched objective from a prediction."""
    plain = data.options.objective == "matched" and not is_timed(data.views)
    return plain and bool(data.predictions) and can_be_together(data.body)

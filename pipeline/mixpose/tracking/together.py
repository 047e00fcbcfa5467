"""Several bodies that are fitted at once, as long as each is where it was expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mixpose.fit import fit_together
from mixpose.judgement import judge_together, nearest_alike
from mixpose.objective import SharedDensities, can_be_together, matched_objective
from mixpose.tracking.frame import Begun, Frame
from mixpose.tracking.likelihood import MatchedLikelihood, Start


def begun_together(frames: Sequence[Frame], shared: SharedDensities) -> list[Frame]:
    """The frames of several bodies with what is climbed from their first predictions, and judged.

    Their sensors are the same, of which `shared` has all that they see; what is not a body's own is
    out of its reach.
    """
    begun = list(frames)
    for k, one in enumerate(frames):
        if not one.is_timed:
            objective = matched_objective(one.views, one.body, one.sigmas, shared=shared)
            begun[k] = replace(one, begun=Begun(objective))
    some = [k for k, one in enumerate(begun) if _is_climbed(one)]
    if len(some) < 2:
        return begun
    first = begun[some[0]]
    ascents = fit_together(
        [begun[k].finest for k in some],
        [begun[k].predictions[0].T_world_object for k in some],
        first.free,
        first.rules.fit,
    )
    fits, cases = {}, []  # of judgement: objective, pose, noise before, prior, what the fit saw
    for k, end in zip(some, ascents, strict=True):
        if end is not None:
            objective, ascent = end
            begun[k] = replace(begun[k], begun=Begun(objective))
            data, expected = begun[k], begun[k].predictions[0]
            start = Start(expected.T_world_object, expected.uncertainty, expected)
            fits[k] = MatchedLikelihood(data).fit(start, ascent)
            T = nearest_alike(fits[k].T_world_object, data.body, data.T_reference)
            seen = (fits[k].matches, fits[k].noise) if T is fits[k].T_world_object else (None, None)
            cases.append((data.finest, T, data.track.residuals, data.prior(T), *seen))
    judged = judge_together(cases, first.free, first.rules.judgement) if cases else []
    for (k, fit), found in zip(fits.items(), judged, strict=True):
        begun[k] = replace(begun[k], begun=Begun(begun[k].finest, fit, found))
    return begun


def _is_climbed(data: Frame) -> bool:
    """Whether a fit begins by climbing the matched objective from a prediction."""
    plain = data.options.objective == "matched" and not data.is_timed
    return plain and bool(data.predictions) and can_be_together(data.body)

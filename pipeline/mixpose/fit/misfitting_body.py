"""Grey values and profiles: the most probable pose, also of a body that does not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.fit.free_features import fit_freed
from mixpose.fit.misfit import MisfitRules, SensorDensity, misfit
from mixpose.fit.prior import Prior, likelihood_near, most_probable
from mixpose.objective import MatchedObjective, View, matched_objective, project_body
from mixpose.rigid import transform

Floats: TypeAlias = NDArray[np.float64]


def believed(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    prior: Prior,
    rules: MisfitRules = MisfitRules(),
) -> tuple[Floats, bool]:
    """The most probable pose, or the fit to freed features of a body that does not fit.

    Parameters
    ----------
    views : sequence of View
        All with noise in their cells.
    body : Body
    T_world_object : (4, 4) array
        A maximum of the likelihood.
    prior : Prior
    rules : MisfitRules

    Returns
    -------
    (4, 4) array
    bool
        Whether features were freed.
    """
    points = body.nodes.points
    T = most_probable(views, body, T_world_object, prior)
    seen = project_body(tuple(view.sensor for view in views), body).project(T[None]).seen
    if not seen.all() or len(points) != len(body):
        return T, False
    near = likelihood_near(views, body, T)
    here = [
        SensorDensity(
            view.sensor,
            partial(_sampled, near.objective, k),
            float(near.objective.variances[k, 0]),
            float(near.noise[k]),
            view.observation.extent,
        )
        for k, view in enumerate(views)
    ]
    ratio = misfit(here, transform(T, points), int(prior.free.sum()), rules)
    if ratio == 1:
        return T, False
    everywhere = matched_objective(views, body, [view.observation.sigma for view in views])
    whole = [replace(one, density=partial(_sampled, everywhere, k)) for k, one in enumerate(here)]
    T_freed = fit_freed(whole, points, [T, *prior.points()], prior.free)
    if T_freed is not None:
        return T_freed, True
    # what is left at features is no noise of cells: in a body that does not fit it is as large
    return most_probable(views, body, T, prior, ratio), False


def _sampled(objective: MatchedObjective, sensor: int, y: Floats) -> Floats:
    """C and its gradient (n, 1 + m) in one sensor at places (n, m)."""
    padded = np.zeros((len(objective.views), 1, len(y), 2))
    padded[sensor, 0, :, : y.shape[1]] = y
    return objective.atlas.look_up(padded)[sensor, 0, :, : 1 + y.shape[1]]

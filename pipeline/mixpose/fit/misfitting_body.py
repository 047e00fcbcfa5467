"""Grey values and profiles: the most probable pose, also of a body that does not fit."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.fit.free_features import fit_freed
from mixpose.fit.misfit import MisfitRules, SensorDensity, misfit
from mixpose.fit.prior import NormalPrior, most_probable, with_amplitudes
from mixpose.objective import MatchedObjective, matched_objective
from mixpose.objective.matched import STEPS_PER_SIGMA
from mixpose.rigid import transform

Floats: TypeAlias = NDArray[np.float64]


def believed(
    objective: MatchedObjective,
    T_world_object: Floats,
    prior: NormalPrior,
    rules: MisfitRules = MisfitRules(),
) -> tuple[Floats, bool]:
    """The most probable pose, or the fit to freed features of a body that does not fit.

    Parameters
    ----------
    objective : MatchedObjective
        At σ_ε of sensors with noise in their cells.
    T_world_object : (4, 4) array
        A maximum of the objective.
    prior : NormalPrior
    rules : MisfitRules

    Returns
    -------
    (4, 4) array
    bool
        Whether features were freed.
    """
    body = objective.projection.body
    points = body.nodes.points
    T = most_probable(objective, T_world_object, prior)
    T_unlike, noises = with_amplitudes(objective, T, prior, rules.unlike, rules.believed)
    if not objective.projection.project(T[None]).seen.all() or len(points) != len(body):
        return T_unlike, False
    densities = [
        SensorDensity(
            view.sensor,
            partial(_sampled, objective, k),
            float(objective.variances[k, 0]),
            float(noise),
            view.observation.extent,
        )
        for k, (view, noise) in enumerate(zip(objective.views, noises, strict=True))
    ]
    ratio = misfit(densities, transform(T_unlike, points), int(prior.free.sum()), rules)
    if ratio == 1:
        return T_unlike, False
    sigmas = [view.observation.sigma for view in objective.views]
    # to look for peaks everywhere
    rough = matched_objective(objective.views, body, sigmas, steps_per_sigma=STEPS_PER_SIGMA)
    whole = [replace(one, density=partial(_sampled, rough, k)) for k, one in enumerate(densities)]
    T_freed = fit_freed(whole, points, [T, *prior.points()], prior.free)
    if T_freed is not None:
        return T_freed, True
    # what is left at features is no noise of cells: in a body that does not fit it is as large
    T = most_probable(objective, T, prior, ratio)
    found = with_amplitudes(objective, T, prior, rules.unlike, rules.believed, ratio)
    return found[0], False


def _sampled(objective: MatchedObjective, sensor: int, y: Floats) -> Floats:
    """C and its gradient (n, 1 + m) in one sensor at places (n, m)."""
    padded = np.zeros((len(objective.views), 1, len(y), 2))
    padded[sensor, 0, :, : y.shape[1]] = y
    return objective.atlas.look_up(padded)[sensor, 0, :, : 1 + y.shape[1]]

"""Fit grey values and profiles: the most probable pose, also of a body that does not fit.

Under white noise the log-likelihood with the best amplitude is half of the energy ⟨g, h⟩² / ⟨h, h⟩
that a pose explains, over the noise of a cell; to it is added the Gaussian prior of the start.
Maxima are climbed from that of the objective, and under heavy noise also from the points of the
cubature rule of third degree, which have the mean and covariance of the prior.

Features of a deformed body are assigned to places, the peaks of a density, with the least sum of
squares S; the pose is fitted to them, and so on.  The probability of an assignment is ∝ S^(−ν/2) if
misfits of ν redundant coordinates are normal; see *A body that does not fit* in `docs/method.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.constants import constant
from mixpose.density import peak
from mixpose.objective import (
    AmplitudesObjective,
    BodyProjection,
    MatchedObjective,
    NormalPrior,
    matched_objective,
)
from mixpose.objective.matched import FINE_STEPS, STEPS_PER_SIGMA, value_error
from mixpose.optimise import NewtonOptions, Quadratic, Sum, Term, ascend, squares_of
from mixpose.records import Floats, Indices, Mask, replace
from mixpose.rigid import perturb, transform
from mixpose.sensors import Sensor


@dataclass(frozen=True)
class FitRules:
    """Rules where a fit begins and ends, and when a body does not fit."""

    ratio: float = constant(
        1.8, "blur from level to level: below 2, a peak lies in the basin of the next level's"
    )
    widest: float = constant(
        0.1, "of the observed extent: with wider blurs all is a single blob (design study)"
    )
    near: float = constant(
        0.1,
        "value per sensor from which the fit begins at σ_ε: features have a third of their peak "
        "on average; below, it descends through the blurs",
    )
    narrower: float = constant(0.8, "of a blur: the next is drawn only if it is as much narrower")
    moved: float = constant(
        0.3,
        "standard deviations by which narrower blurs, or weights by each sensor's noise, have to "
        "move the pose: less adds 1.5 % to the squared error of six directions",
    )
    believed: float = constant(
        0.99, "probability of χ² up to which a misfit is taken for noise: one frame in a hundred"
    )
    unlike: float = constant(
        0.3, "spread of the features' brightness, relative: markers of one kind under one lamp"
    )
    nats: float = constant(1e-6, "log-likelihood of 1e-3 σ; of the energy: heights are 1e-3 off")
    sharp: NewtonOptions = constant(
        NewtonOptions(40, 1e-6, remaining=5e-7, value_error=value_error(STEPS_PER_SIGMA)),
        "a step of gain 5e-7 is 1e-3 σ long; gains shrink faster near the end: 1 % remains",
    )
    coarse: NewtonOptions = constant(
        NewtonOptions(10, 1e-3, remaining=5e-7, value_error=value_error(STEPS_PER_SIGMA)),
        "at blurs before σ_ε: the next level goes on",
    )
    fine: NewtonOptions = constant(
        NewtonOptions(40, 1e-8, value_error=value_error(FINE_STEPS)), "of grey values and integrals"
    )


@dataclass(frozen=True)
class Likelihood:
    """Log-likelihood of densities with noise in every cell."""

    objective: MatchedObjective  # in nats
    shares: Floats  # (L,) of the energy ⟨g, g⟩ that the pose explains
    noise: Floats  # (L,) variance of a cell's noise times the size of a cell

    @property
    def is_alone(self) -> bool:
        """Whether no other pose can be as likely, as shares of poses sum to at most 1 (Bessel)."""
        return bool(self.shares.min() > 0.5)


def likelihood_at(
    objective: MatchedObjective, T_world_object: Floats, misfit: float = 1.0
) -> Likelihood:
    """Return the log-likelihood whose noise is what a pose leaves at σ_ε, times `misfit`."""
    plain = replace(objective, weights=np.ones_like(objective.weights))
    shares = plain.shares(T_world_object[None])[:, 0]
    cells = np.array([view.observation.cells for view in objective.views])
    noise = cell_variances(objective.energies[:, 0], shares, cells)
    weights = (0.5 * objective.energies[:, 0] / (misfit * noise))[:, None]
    return Likelihood(replace(objective, weights=weights), shares, noise)


def cell_variances(energies: Floats, shares: Floats, cells: Indices) -> Floats:
    """Return noise variances of cells times their size (L,): unexplained energy over cells."""
    # shares are quotients of single-precision numbers: a remainder below 1e-9 is not known
    return np.asarray(np.maximum(1 - shares, 1e-9) * energies / cells)


def most_probable(
    objective: MatchedObjective,
    T_world_object: Floats,
    prior: NormalPrior,
    rules: FitRules = FitRules(),
    misfit: float = 1.0,
) -> Floats:
    """Return the pose (4, 4) that maximises likelihood and prior, from the objective's maximum."""
    T, likelihood = T_world_object, likelihood_at(objective, T_world_object, misfit)
    if not likelihood.is_alone:
        starts = np.concatenate([T[None], prior.points()])
        # roughly, to find the highest of several maxima
        T = _climbed(likelihood.objective, prior, starts, 1e4 * rules.nats)
    for _ in range(2):  # the second time with the noise that the maximum leaves
        T = _climbed(likelihood_at(objective, T, misfit).objective, prior, T[None], rules.nats)
    return T


def believed(
    objective: MatchedObjective,
    T_world_object: Floats,
    prior: NormalPrior,
    rules: FitRules = FitRules(),
) -> tuple[Floats, bool]:
    """Return the most probable pose (4, 4) near a maximum at σ_ε, or, if the body does not fit, the
    fit to freed features; and whether it is the latter.
    """
    projection, body = objective.projection, objective.projection.body
    T = most_probable(objective, T_world_object, prior, rules)
    T_unequal, noises = with_amplitudes(objective, T, prior, rules)
    ratio, points = 1.0, transform(T_unequal, body.nodes.points)
    if projection.project(T[None]).seen.all() and len(points) == len(body):
        ratio = misfit(_densities(objective, noises), points, int(prior.free.sum()), rules)
    if ratio == 1:
        return T_unequal, False
    sigmas = [view.observation.sigma for view in objective.views]
    # coarser, to look for peaks everywhere
    rough = matched_objective(objective.views, body, sigmas, steps_per_sigma=STEPS_PER_SIGMA)
    starts = np.concatenate([T[None], prior.points()])
    T_freed = fit_freed(projection, _densities(rough, noises), starts, prior.free)
    if T_freed is not None:
        return T_freed, True
    # what remains at features of a body that does not fit is larger than the noise of cells
    T = most_probable(objective, T, prior, rules, ratio)
    return with_amplitudes(objective, T, prior, rules, ratio)[0], False


def with_amplitudes(
    objective: MatchedObjective,
    T_world_object: Floats,
    prior: NormalPrior,
    rules: FitRules,
    misfit: float = 1.0,
) -> tuple[Floats, Floats]:
    """Return the most probable pose, by unequal brightness if likelier, and the noise (L,)."""
    T, equal = T_world_object, likelihood_at(objective, T_world_object).noise
    noise, cells = equal, np.array([view.observation.cells for view in objective.views])
    smallest = rules.nats * objective.energies[:, 0] / cells
    for _ in range(3):  # noise and pose by turns: the noise holds to a part in a hundred
        unequal = AmplitudesObjective(objective, noise, rules.unlike)
        noise = np.maximum(unequal.unexplained(T) / cells, smallest)
        T = _climbed(replace(unequal, noise=misfit * noise), prior, T[None], rules.nats)
    # twice the logarithm of the ratio of likelihoods, each with its own noise
    gain = float(cells @ np.log(np.maximum(equal, smallest) / noise))
    freedom = len(cells) * (len(objective.projection.body.nodes.points) - 1)
    return (T, noise) if gain >= chdtri(freedom, 1 - rules.believed) else (T_world_object, equal)


def _densities(objective: MatchedObjective, noises: Floats) -> list[SensorDensity]:
    """Return the densities that an objective has drawn."""

    def sampled(sensor: int, y: Floats) -> Floats:
        padded = np.zeros((len(objective.views), 1, len(y), 2))
        padded[sensor, 0, :, : y.shape[1]] = y
        return objective.atlas.look_up(padded)[sensor, 0, :, : 1 + y.shape[1]]

    by_view = zip(objective.views, objective.variances[:, 0].tolist(), noises.tolist(), strict=True)
    return [
        SensorDensity(view.sensor, partial(sampled, k), variance, noise, view.observation.extent)
        for k, (view, variance, noise) in enumerate(by_view)
    ]


def _climbed(likelihood: Term, prior: NormalPrior, starts: Floats, nats: float) -> Floats:
    """Climb from starts (H, 4, 4) to the highest maximum (4, 4) of likelihood and prior."""
    options = NewtonOptions(60, 1e-11, value_error=value_error(FINE_STEPS), negligible=nats)
    ends = ascend(Sum((likelihood, prior)), starts, perturb, prior.free, options)
    return np.asarray(ends.states[int(np.argmax(ends.values))])


@dataclass(frozen=True)
class SensorDensity:
    """The matched density of a sensor, as a function of places."""

    geometry: Sensor
    density: Callable[[Floats], NDArray[Any]]  # with its gradient (n, 1 + m) at places (n, m)
    variance: float  # 2σ², that of a feature in the matched density, in squared sensor units
    cell_variance: float  # of the noise of a cell, times the size of a cell
    extent: tuple[Floats, Floats]  # smallest and largest coordinates (m,) of the density's cells

    def residuals(self, y: Floats) -> tuple[Floats, Floats]:
        """Return the gradient (n, m) less that of features (n, m), times √2 σ, and heights (n,)."""
        away = (y[:, None] - y) / np.sqrt(self.variance)
        bells = np.exp(-0.5 * (away * away).sum(axis=2))
        sampled = self.density(y).astype(np.float64)
        # features nearer than 1e-4 of √2 σ have one height
        heights = np.linalg.solve(bells + 1e-9 * np.eye(len(y)), sampled[:, 0])
        slopes = -((bells * heights)[..., None] * away).sum(axis=1)
        return np.sqrt(self.variance) * sampled[:, 1:] - slopes, heights

    def noise(self) -> float:
        """Return the standard deviation of the noise of the matched density."""
        return float(np.sqrt(self.cell_variance * peak(self.variance, self.geometry.dimension)))


def misfit(
    densities: Sequence[SensorDensity],
    points: Floats,
    unknowns: int,  # of the pose, that were fitted beside each feature's height
    rules: FitRules = FitRules(),
) -> float:
    """Return χ² per degree of freedom of residuals at features (n, 3); 1 if they may be noise."""
    statistic, freedom = 0.0, -unknowns
    for sensor in densities:
        slopes, heights = sensor.residuals(sensor.geometry.project(points)[0])
        # drawing rounds heights to 1/512
        statistic += float((slopes**2).sum() / (sensor.noise() ** 2 + (heights.mean() / 512) ** 2))
        freedom += slopes.size
    if freedom <= 0 or statistic < float(chdtri(freedom, 1 - rules.believed)):
        return 1.0
    return statistic / freedom


def own_peaks(sensor: SensorDensity, count: int) -> Floats | None:
    """Return the places (n, m) where `count` features explain most, if all have separate peaks."""
    from scipy.ndimage import maximum_filter  # noqa: PLC0415 - takes long to import, seldom needed

    step = np.sqrt(sensor.variance / 8)  # half of σ
    limits = zip(*sensor.extent, strict=True)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, step) for a, b in limits)), axis=-1)
    heights = sensor.density(grid.reshape(-1, grid.shape[-1]))[:, 0].reshape(grid.shape[:-1])
    peaks = (heights == maximum_filter(heights, size=3)) & (heights > 0)
    order = np.argsort(-heights[peaks])
    if len(order) < count:
        return None
    y = grid[peaks][order[:count]]
    for _ in range(30):  # peaks at least two widths apart draw each other by 0.4 of a step
        slopes, tops = sensor.residuals(y)
        if tops.min() <= 0:
            return None
        y = y + np.sqrt(sensor.variance) * slopes / tops[:, None]
    chance = sensor.noise() * np.sqrt(2 * np.log(heights.size))
    highest = heights[peaks][order[count:]].max(initial=chance)
    return y if highest < 0.5 * tops.mean() < sensor.density(y)[:, 0].min() else None


@dataclass(frozen=True)
class LabelledPlaces:
    """Minus half the sum of squares between features and the places assigned to them."""

    projection: BodyProjection
    places: Floats  # (L, n, 2) in unknown order
    scales: Floats  # (L,) 1 / σ
    labels: Indices  # (L, n), number of the place of each feature

    def offsets(self, poses: Floats) -> tuple[Floats, Floats]:
        """Return places less projections (H, 2Ln), in units of σ, and Jacobians (H, 2Ln, 6)."""
        match, H = self.projection.project(poses), len(poses)
        taken = np.take_along_axis(self.places, self.labels[..., None], axis=1)
        scales = self.scales[:, None, None, None]
        offsets, J = scales * (taken[:, None] - match.y), scales[..., None] * match.J
        return offsets.swapaxes(0, 1).reshape(H, -1), J.swapaxes(0, 1).reshape(H, -1, 6)

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        return squares_of(*self.offsets(poses))

    def nearest(self, T: Floats) -> Indices:
        """Return the labels with the least sum of squares at a pose (4, 4)."""
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - as above

        y = self.projection.project(T[None]).y[:, 0]
        costs = ((y[:, :, None] - self.places[:, None]) ** 2).sum(axis=3)
        return np.array([linear_sum_assignment(cost)[1] for cost in costs])

    def fitted(self, T: Floats, free: Mask) -> tuple[float, Floats, LabelledPlaces]:
        """Fit from a pose; return the sum of squares, the pose, and the term with its labels."""
        tried = set[bytes]()
        while (labels := self.nearest(T)).tobytes() not in tried:
            tried.add(labels.tobytes())
            term = replace(self, labels=labels)
            end = ascend(term, T[None], perturb, free, NewtonOptions(60, tolerance=1e-13))
            T = end.states[0]
        return -2 * float(end.values[0]), T, term

    def exchanged(self, T: Floats, free: Mask) -> list[float]:
        """Return sums of squares, to first order, after any exchange of two labels of a sensor."""
        Q, _ = np.linalg.qr(self.offsets(T[None])[1][0][:, free])
        count, n = self.labels.shape
        squares = []
        for k, (i, j) in product(range(count), combinations(range(n), 2)):
            labels = self.labels.copy()
            labels[k, [i, j]] = labels[k, [j, i]]
            offsets = replace(self, labels=labels).offsets(T[None])[0][0]
            squares.append(float(offsets @ offsets) - float(np.sum((offsets @ Q) ** 2)))
        return squares


def fit_freed(
    projection: BodyProjection, densities: Sequence[SensorDensity], starts: Floats, free: Mask
) -> Floats | None:
    """Fit the pose to freed features by least squares, from starts (H, 4, 4).

    All sensors see all features, of equal weight; None if the assignment of places is not sure.
    """
    count = len(projection.body)
    redundant = int(projection.dimensions.sum()) * count - int(free.sum())
    places = np.zeros((len(densities), count, 2))
    for k, density in enumerate(densities):
        y = own_peaks(density, count) if redundant > 0 else None
        if y is None:
            return None
        places[k, :, : y.shape[1]] = y
    scales = np.sqrt(2 / np.array([sensor.variance for sensor in densities]))
    term = LabelledPlaces(projection, places, scales, np.zeros(places.shape[:2], np.intp))
    ends = sorted((term.fitted(T, free) for T in starts), key=lambda end: end[0])
    least, T_best, best = ends[0]
    rivals = {
        end.labels.tobytes(): squares
        for squares, _, end in ends
        if (end.labels != best.labels).any()
    }
    other_squares = np.array([*rivals.values(), *best.exchanged(T_best, free)])
    return T_best if ((other_squares / least) ** (-0.5 * redundant)).sum() < 1 else None

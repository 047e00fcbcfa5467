"""Damped Newton ascent of a term from many states at once.

Knows neither images nor poses: a term gives second-order models, and the caller says how steps
move states.  Each state has its damping and its end; those that ended are evaluated no further.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf

from mixpose.constants import constant
from mixpose.optimise.term import Quadratic, Term
from mixpose.records import Floats, Indices, Mask

_ROUNDING = np.finfo(np.float64)


@dataclass(frozen=True)
class NewtonOptions:
    """When to stop and how to damp.

    Attributes
    ----------
    iterations : int
        Most evaluations of a state's model.
    tolerance : float
        The step that is expected to gain less than this share of the value is the last.
    damping : float
        First Levenberg-Marquardt damping, as a share of the curvature's diagonal.
    value_error : float
        Relative error of values, as from interpolation.  Gains below it cannot be seen in the
        value; there a step is good when less gain is left after it: the zero of the gradient is
        sought, which interpolation does not move.
    remaining : float
        The step that is expected to leave less than this share of the value to be gained is the
        last, too: gains shrink by about the same factor from step to step.
    negligible : float
        The step that is expected to gain less than this, in the unit of the value, is the last.
    unchecked : bool
        Whether as many steps are taken as there are iterations, with the first damping and
        whatever they gain: in a search, where the best of many is sought.
    together : bool
        Whether states that ended are evaluated along, as of terms that have data for each state.
    least_curvature, held_back, extreme : float
        See the fields.
    """

    iterations: int = 30
    tolerance: float = 1e-12
    damping: float = 1e-4
    value_error: float = 0.0
    remaining: float = 0.0
    negligible: float = 0.0
    unchecked: bool = False
    together: bool = False
    least_curvature: float = constant(
        0.3, "of the curvature: where a Hessian is flatter, its step would lead too far"
    )
    held_back: float = constant(1e-2, "damping after a step that led astray, at least")
    extreme: float = constant(1e9, "damping at which steps move nothing; its inverse is none")


class Ascent(NamedTuple):
    """Where the ascents of H states ended."""

    states: Any  # with a leading axis H
    values: Floats  # (H,)
    converged: Mask  # (H,) false where the iterations ran out
    iterations: Indices  # (H,) evaluations
    last: Quadratic  # models at the best states that were evaluated
    steps: Floats  # (H, q) that were taken from there unseen

    def of(self, rows: slice) -> Ascent:
        """The ascents of some of the states."""
        return Ascent(
            self.states[rows],
            self.values[rows],
            self.converged[rows],
            self.iterations[rows],
            self.last.of(rows),
            self.steps[rows],
        )


def ascend(
    term: Term,
    states: Any,
    move: Callable[[Any, Floats], Any],
    free: Mask,
    options: NewtonOptions = NewtonOptions(),
    at_start: Quadratic | None = None,
) -> Ascent:
    """Climb to a maximum near each of H states.

    Parameters
    ----------
    term : Term
    states : (H, ...) array
    move : callable
        States reached from H states by steps (H, q).
    free : (q,) bool
        Directions that may change.
    options : NewtonOptions
    at_start : Quadratic or None
        The models at the start, where they are at hand.

    Returns
    -------
    Ascent
        The best states seen.
    """
    here = at_start or term.linearise(states)
    climb = _Climb(states, here, None if free.all() else np.flatnonzero(free), options)
    count = len(here.value)
    everything = list(range(count))
    going = climb.unfinished(everything, 1)
    for iteration in range(2, options.iterations + 1):
        if not going:
            break
        asked = everything if options.together else going
        if len(asked) == count:
            candidates = move(climb.states, climb.steps)
        else:
            candidates = move(climb.states[asked], climb.steps[asked])
        going = climb.take(candidates, term.linearise(candidates), asked, going, iteration)
        going = climb.unfinished(going, iteration)
    return climb.ended(move)


class _Climb:
    """States on their way, with the models there and the steps to be tried next."""

    def __init__(
        self, states: Any, here: Quadratic, free: Indices | None, options: NewtonOptions
    ) -> None:
        count = len(here.value)
        self.states = states
        self._here, self._free, self._options = here, free, options
        self._damping = [options.damping] * count
        self.steps, self._gains = _steps(here, free, self._damping, options)
        self._before = [0.0] * count  # gains of the steps before these
        self._converged = [False] * count
        self._iterations = [options.iterations] * count
        self._is_taken = [options.unchecked] * count  # whether the step is taken unseen
        self._is_shared = True  # whether others have the arrays of states and models

    def unfinished(self, going: list[int], iteration: int) -> list[int]:
        """Those of some states that have not arrived after so many evaluations."""
        options = self._options
        if options.unchecked or iteration == options.iterations:
            return going
        left, values = [], self._here.value.tolist()
        for k in going:
            size, gain = abs(values[k]), self._gains[k]
            is_near = gain**2 <= options.remaining * size * self._before[k]
            if is_near or gain <= max(options.tolerance * size, options.negligible):
                # so near, the model is right: its last step is taken unseen
                self._is_taken[k] = self._converged[k] = True
                self._iterations[k] = iteration
            else:
                left.append(k)
        return left

    def take(
        self, states: Any, there: Quadratic, asked: list[int], going: list[int], iteration: int
    ) -> list[int]:
        """Go to states that are better, and damp the other steps: those that are not stuck."""
        options, values, better = self._options, self._here.value.tolist(), there.value.tolist()
        own, least = self._damping, 1 / options.extreme
        damping = own if options.unchecked else [max(own[k] / 10, least) for k in asked]
        steps, gains = _steps(there, self._free, damping, options)
        accepted, rejected = [], []
        for row, k in enumerate(asked):
            gain, is_asked = self._gains[k], len(going) == len(asked) or k in going
            is_close = gain <= options.value_error * abs(values[k])
            is_better = better[row] > values[k] or (is_close and gains[row] < gain)
            if is_asked and (is_better or options.unchecked):
                self._before[k], self._gains[k], own[k] = gain, gains[row], damping[row]
                accepted.append(row)
            elif is_asked:
                own[k] = max(10 * own[k], options.held_back)
                if own[k] <= options.extreme:
                    rejected.append(k)
                else:
                    self._converged[k], self._iterations[k] = is_close, iteration
        if len(accepted) == len(own):
            self.states, self._here, self.steps, self._is_shared = states, there, steps, True
            return going
        self._go(states, there, steps, accepted, [asked[row] for row in accepted])
        if rejected:
            self._try_again(rejected)
        return sorted([*(asked[row] for row in accepted), *rejected])

    def ended(self, move: Callable[[Any, Floats], Any]) -> Ascent:
        """Where all states are, once the last steps are taken."""
        states, values, steps = self.states, self._here.value, self.steps
        if all(self._is_taken):
            states, values = move(states, steps), values + self._gains
        elif any(self._is_taken):
            taken = np.array(self._is_taken)
            steps = np.where(taken[:, None], steps, 0.0)
            states, values = states.copy(), values + np.where(taken, self._gains, 0.0)
            states[taken] = move(states[taken], steps[taken])
        else:
            steps = np.zeros(steps.shape)
        iterations = np.array(self._iterations)
        return Ascent(states, values, np.array(self._converged), iterations, self._here, steps)

    def _go(
        self, states: Any, there: Quadratic, steps: Floats, accepted: list[int], to: list[int]
    ) -> None:
        """Let some rows of what was evaluated be where their states are."""
        if not accepted:
            return
        if self._is_shared:
            here = self._here
            hessian = None if here.hessian is None else here.hessian.copy()
            self._here = Quadratic(
                here.value.copy(), here.gradient.copy(), here.curvature.copy(), hessian
            )
            self.states, self._is_shared = self.states.copy(), False
        self.states[to], self.steps[to] = states[accepted], steps[accepted]
        for own, other in zip(self._here[:4], there[:4], strict=True):
            if own is not None and other is not None:
                own[to] = other[accepted]

    def _try_again(self, rejected: list[int]) -> None:
        """Damp the steps of some states more."""
        damping = [self._damping[k] for k in rejected]
        some = self._here if len(rejected) == len(self._gains) else self._here.of(rejected)
        self.steps[rejected], gains = _steps(some, self._free, damping, self._options)
        for k, gain in zip(rejected, gains, strict=True):
            self._gains[k] = gain


def _steps(
    here: Quadratic, free: Indices | None, damping: list[float], options: NewtonOptions
) -> tuple[Floats, list[float]]:
    """Damped Newton steps (H, q), and the gains that the models expect of them."""
    C, g, hessian = here.curvature, here.gradient, here.hessian
    if len(damping) == 1 and free is None and hessian is None:  # no time for broadcasting
        step, gain = _step(C[0], g[0], damping[0])
        return step[None], [gain]
    if free is not None:
        C, g = C[:, free[:, None], free], g[:, free]
        hessian = None if hessian is None else hessian[:, free[:, None], free]
    if hessian is not None:
        lowest = options.least_curvature * C
        definite = [_is_definite(one) for one in hessian - lowest]
        C = np.where(np.array(definite)[:, None, None], hessian, C)
    if len(g) == 1:
        single, gain = _step(C[0], g[0], damping[0])
        partial, gains = single[None], [gain]
    else:
        partial, gains = _many_steps(C, g, np.array(damping)[:, None])
    if free is None:
        return partial, gains
    steps = np.zeros(here.gradient.shape)
    steps[:, free] = partial
    return steps, gains


def _step(C: Floats, g: Floats, damping: float) -> tuple[Floats, float]:
    """The step (q,) of one state, and its gain."""
    diagonal = C.diagonal()
    # a direction without curvature must not make the system singular
    floor = max(diagonal.tolist(), default=0.0) * 1e-12 * damping + float(_ROUNDING.tiny)
    A = C.copy()
    A.reshape(-1)[:: len(g) + 1] += (damping + 1e-12) * diagonal + floor
    step = g
    if len(g):
        _, step, failure = dposv(A, g)
        step = np.asarray(np.linalg.solve(A, g), np.float64) if failure else step
    return step, float(step @ (g - 0.5 * (C @ step)))


def _many_steps(C: Floats, g: Floats, damping: Floats) -> tuple[Floats, list[float]]:
    """The steps (H, q) of H states, and their gains."""
    diagonal = np.einsum("hqq->hq", C)
    floor = diagonal.max(axis=1, initial=0.0)[:, None] * 1e-12 * damping + _ROUNDING.tiny
    A = C + ((damping + 1e-12) * diagonal + floor)[:, None] * np.eye(g.shape[1])
    steps = np.linalg.solve(A, g[..., None])[..., 0]
    steps[diagonal.max(axis=1, initial=0.0) <= 0] = 0.0
    gains = (steps * (g - 0.5 * (C @ steps[..., None])[..., 0])).sum(axis=1)
    return steps, gains.tolist()


def _is_definite(A: Floats) -> bool:
    """Whether a symmetric matrix is positive definite."""
    return len(A) > 0 and bool(dpotrf(A)[1] == 0)

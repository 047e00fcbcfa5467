"""Damped Newton ascent on a function of a few numbers.

Knows neither images nor poses: the caller gives a second-order model at a state and says how a
step moves the state.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrf

Floats: TypeAlias = NDArray[np.float64]
_STUCK = 1e9  # damping at which steps no longer move anything
_HELD_BACK = 1e-2  # damping after a step that led astray, at least
_TINY = float(np.finfo(np.float64).tiny)
_LEAST_CURVATURE = 0.3  # of C: where a Hessian is flatter, its step would lead too far
State = TypeVar("State")


class Model(Protocol):
    """Second-order model: value + gᵀδ − ½ δᵀCδ with C positive semidefinite."""

    @property
    def value(self) -> float:
        """Value at the state."""
        ...

    @property
    def gradient(self) -> Floats:
        """Gradient (n,)."""
        ...

    @property
    def curvature(self) -> Floats:
        """C (n, n)."""
        ...

    @property
    def hessian(self) -> Floats | None:
        """Minus the second derivative (n, n) where it is known; used where it is definite."""
        ...


@dataclass(frozen=True)
class NewtonOptions:
    """When to stop and how to damp.

    Attributes
    ----------
    iterations : int
        Most evaluations of the model.
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
    """

    iterations: int = 30
    tolerance: float = 1e-12
    damping: float = 1e-4
    value_error: float = 0.0
    remaining: float = 0.0


@dataclass(frozen=True)
class Ascent(Generic[State]):
    """Where an ascent ended.

    `last` is the model that was evaluated last, and `step` what was taken from there unseen.
    """

    state: State
    value: float
    converged: bool
    iterations: int
    last: Model | None = None
    step: Floats | None = None


class _Inner(NamedTuple):
    """Directions that may change, as a mask and as rows and columns."""

    free: NDArray[np.bool_]
    square: tuple[NDArray[Any], ...]

    @classmethod
    def of(cls, free: NDArray[np.bool_]) -> _Inner | None:
        """None where all may change."""
        return None if free.all() else cls(free, np.ix_(free, free))


def ascend(
    model: Callable[[State], Model],
    move: Callable[[State, Floats], State],
    start: State,
    free: NDArray[np.bool_],
    options: NewtonOptions = NewtonOptions(),
    at_start: Model | None = None,
) -> Ascent[State]:
    """Climb to a maximum near the start.

    Parameters
    ----------
    model : callable
        Second-order model at a state.
    move : callable
        State reached by a step (n,).
    start : state
    free : (n,) bool
        Directions that may change.
    options : NewtonOptions
    at_start : Model or None
        The model at the start, where it is at hand.

    Returns
    -------
    Ascent
        The best state seen; `converged` is false when the iterations ran out.
    """
    climb = _climb(move, start, at_start or model(start), _Inner.of(free), options)
    try:
        state = next(climb)
        while True:
            state = climb.send(model(state))
    except StopIteration as end:
        ascent: Ascent[State] = end.value
        return ascent


def ascend_together(
    models: Callable[[Sequence[State]], Sequence[Model]],
    move: Callable[[State, Floats], State],
    starts: Sequence[State],
    free: NDArray[np.bool_],
    options: NewtonOptions,
    at_starts: Sequence[Model],
) -> list[Ascent[State]]:
    """Climb to a maximum near each start, as `ascend` does, all models evaluated at once.

    Parameters
    ----------
    models : callable
        Models at as many states as there are starts, each of its own function.
    move : callable
    starts : sequence of state
    free : (n,) bool
    options : NewtonOptions
    at_starts : sequence of Model
    """
    inner = _Inner.of(free)
    climbs = [_climb(move, one, here, inner, options) for one, here in zip(starts, at_starts)]
    states, ends = list(starts), dict[int, Ascent[State]]()
    there: Sequence[Model | None] = [None] * len(climbs)
    while True:
        for k, climb in enumerate(climbs):
            if k in ends:
                continue
            try:
                states[k] = climb.send(there[k])
            except StopIteration as end:
                ends[k] = end.value
                states[k] = ends[k].state
        if len(ends) == len(climbs):
            return [ends[k] for k in range(len(climbs))]
        there = models(states)


def _climb(
    move: Callable[[State, Floats], State],
    start: State,
    here: Model,
    inner: _Inner | None,
    options: NewtonOptions,
) -> Generator[State, Any, Ascent[State]]:
    """The climb from one start: yields states, and is sent the models there."""
    state, damping = start, options.damping
    step, gain = _step(here, inner, damping)
    before = 0.0
    for iteration in range(1, options.iterations):
        size = abs(here.value)
        if gain <= options.tolerance * size or gain**2 <= options.remaining * size * before:
            # so near, the model is right: its last step is taken unseen
            return Ascent(move(state, step), here.value + gain, True, iteration, here, step)
        candidate = move(state, step)
        there = yield candidate
        next_damping = max(damping / 10, 1e-9)
        next_step, next_gain = _step(there, inner, next_damping)
        close = gain <= options.value_error * size
        if there.value > here.value or (close and next_gain < gain):
            before, gain, step = gain, next_gain, next_step
            state, here, damping = candidate, there, next_damping
            continue
        damping = max(10 * damping, _HELD_BACK)
        if damping > _STUCK:
            return Ascent(state, here.value, close, iteration, here)
        step, gain = _step(here, inner, damping)
    return Ascent(state, here.value, False, options.iterations, here)


def _step(here: Model, inner: _Inner | None, damping: float) -> tuple[Floats, float]:
    """Damped Newton step and the gain that the model expects of it."""
    C, g, hessian = here.curvature, here.gradient, here.hessian
    if inner is not None:
        C, g = C[inner.square], g[inner.free]
        hessian = None if hessian is None else hessian[inner.square]
    if hessian is not None and _is_definite(hessian - _LEAST_CURVATURE * C):
        C = hessian
    diagonal = C.diagonal()
    # a direction without curvature must not make the system singular
    floor = max(diagonal.tolist(), default=0.0) * 1e-12 * damping + _TINY
    A = C.copy()
    A.reshape(-1)[:: len(g) + 1] += (damping + 1e-12) * diagonal + floor
    partial = _solved(A, g)
    gain = float(partial @ (g - 0.5 * (C @ partial)))
    if inner is None:
        return partial, gain
    step = np.zeros(len(inner.free))
    step[inner.free] = partial
    return step, gain


def _solved(A: Floats, b: Floats) -> Floats:
    """X with A x = b, for A symmetric and as a rule positive definite."""
    if not len(b):
        return b
    _, x, failure = dposv(A, b)
    return np.asarray(np.linalg.solve(A, b) if failure else x)


def _is_definite(A: Floats) -> bool:
    """Whether a symmetric matrix is positive definite."""
    return len(A) > 0 and bool(dpotrf(A)[1] == 0)

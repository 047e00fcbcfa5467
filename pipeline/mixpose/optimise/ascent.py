"""Terms of an objective, and the damped Newton ascent of their sum from many states at once.

Knows neither images nor poses: a term gives second-order models, and the caller says how steps
move states.  Each state has its damping and its end; those that ended are evaluated no further.
What gradients showed along its last steps corrects the curvature of the terms (limited-memory BFGS,
Nocedal, Math. Comp. 35 (1980) 773): one that is too large along some direction, as that of
mean-shift where offsets are as large as the blur, would lead there in ever smaller steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf

from mixpose.constants import constant
from mixpose.records import Floats, Mask

_TINY = float(np.finfo(np.float64).tiny)
_NO_DAMPING = float(np.sqrt(np.finfo(np.float64).eps))  # and by its inverse steps move nothing


class Quadratic(NamedTuple):
    """Second-order models at H states: value + gᵀδ − ½ δᵀCδ of q numbers."""

    value: Floats  # (H,)
    gradient: Floats  # (H, q)
    curvature: Floats  # (H, q, q), symmetric, positive semidefinite
    hessian: Floats | None = None  # minus the second derivatives (H, q, q); may be indefinite

    def of(self, rows: Any) -> Quadratic:
        """The models at some of the states."""
        return Quadratic._make(None if part is None else part[rows] for part in self)


class Term(Protocol):
    """A function of a state, to be maximised: any evidence, any knowledge."""

    def linearise(self, states: Any) -> Quadratic:
        """Second-order models at H states, which have a leading axis H."""
        ...


@dataclass(frozen=True)
class Sum:
    """The sum of terms, which is a term."""

    terms: tuple[Term, ...]

    def linearise(self, states: Any) -> Quadratic:
        """Second-order models at H states; Hessians where all terms know theirs."""
        columns = zip(*[term.linearise(states) for term in self.terms], strict=True)
        is_open = [(column, any(part is None for part in column)) for column in columns]
        return Quadratic._make(None if some else np.sum(parts, axis=0) for parts, some in is_open)


@dataclass(frozen=True)
class NewtonOptions:
    """When to stop and how to damp; a step that meets one of the ends is the last."""

    iterations: int = 30  # most evaluations of a state's model
    tolerance: float = 1e-12  # end: the step is expected to gain less than this share of the value
    damping: float = 1e-4  # first Levenberg-Marquardt damping, as a share of the diagonal
    # relative error of values, as from interpolation, which does not move the zero of the gradient:
    # below it a step is good when less gain is left after it
    value_error: float = 0.0
    # end: less than this share of the value is left to be gained after the step, as gains shrink by
    # about the same factor from step to step
    remaining: float = 0.0
    negligible: float = 0.0  # end: the step gains less than this, in the unit of the value
    together: bool = False  # states that ended are evaluated along: the term has data for each
    least_curvature: float = constant(
        0.3, "of the curvature: where a Hessian is flatter, its step would lead too far"
    )
    shown_from: float = constant(
        2.5e-3,
        "of the value, that a step gains at most before its gradients are believed: r²/4σ² of a "
        "tenth of the blur; farther away longer steps lead to another maximum",
    )
    least_seen: float = constant(
        0.1, "the same of what gradients show along a step (Powell, Math. Program. 14 (1978) 224)"
    )


class Ascent(NamedTuple):
    """Where the ascents of H states ended: at the best states that were seen."""

    states: Any  # with a leading axis H
    values: Floats  # (H,)
    last: Quadratic  # models at the best states that were evaluated; the last step is taken unseen

    def of(self, rows: slice) -> Ascent:
        """The ascents of some of the states."""
        return Ascent(self.states[rows], self.values[rows], self.last.of(rows))


def ascend(
    term: Term,
    states: Any,  # (H, ...) array
    move: Callable[[Any, Floats], Any],  # the states reached from H states by steps (H, q)
    free: Mask,  # (q,) directions that may change
    options: NewtonOptions = NewtonOptions(),
    at_start: Quadratic | None = None,  # the models at the start, where they are at hand
) -> Ascent:
    """Climb to a maximum near each of H states."""
    climb = _Climb(states, at_start or term.linearise(states), free, options)
    going = everything = list(range(len(climb.gains)))
    for _ in range(options.iterations - 1):
        going = climb.unfinished(going)
        if not going:
            break
        asked = everything if options.together else going
        some = slice(None) if asked == everything else asked
        tried = move(climb.states[some], climb.steps[some])
        going = climb.take(tried, term.linearise(tried), asked, going)
    return climb.ended(move)


def stepped(
    term: Term,
    states: Any,  # H states
    move: Callable[[Any, Floats], Any],  # as for `ascend`
    free: Mask,  # (q,)
    count: int,  # steps
    damping: float = NewtonOptions.damping,
) -> Ascent:
    """Go so many steps from each of H states, whatever they gain: where the best of many counts."""
    can_change, options = free.astype(np.float64), NewtonOptions(damping=damping)
    for _ in range(count):
        here = term.linearise(states)
        steps, gains = _steps(here, can_change, [damping] * len(here.value), options)
        states = move(states, steps)
    return Ascent(states, here.value + gains, here)


class _Climb:
    """States on their way, with the models there and the steps to be tried next."""

    def __init__(self, states: Any, here: Quadratic, free: Mask, options: NewtonOptions) -> None:
        count = len(here.value)
        self.states, self._here, self._options = states, here, options
        self._free = free.astype(np.float64)
        self._damping = [options.damping] * count
        self.steps, self.gains = _steps(here, self._free, self._damping, options)
        self._before = [0.0] * count  # gains of the steps before these
        self._shown: list[list[tuple[Floats, Floats]]] = [[] for _ in range(count)]
        self._is_taken = [False] * count  # whether the step is taken unseen

    def unfinished(self, going: list[int]) -> list[int]:
        """Those of some states that have not arrived."""
        options = self._options
        left, values = [], self._here.value.tolist()
        for k in going:
            size, gain = abs(values[k]), self.gains[k]
            is_near = gain**2 <= options.remaining * size * self._before[k]
            if is_near or gain <= max(options.tolerance * size, options.negligible):
                # so near, the model is right: its last step is taken unseen
                self._is_taken[k] = True
            else:
                left.append(k)
        return left

    def take(self, tried: Any, there: Quadratic, asked: list[int], going: list[int]) -> list[int]:
        """Go to states that are better, and damp the other steps: those that are not stuck."""
        options, values, better = self._options, self._here.value.tolist(), there.value.tolist()
        if there.hessian is None:
            there = self._as_shown(there, asked)
        count = len(values)
        damping = [max(self._damping[k] / 10, _NO_DAMPING) for k in asked]
        steps, gains = _steps(there, self._free, damping, options)
        chosen, left = list(range(count)), []
        for row, k in enumerate(asked):
            if len(going) < len(asked) and k not in going:
                continue
            gain = self.gains[k]
            is_close = gain <= options.value_error * abs(values[k])
            is_better = better[row] > values[k] or (is_close and gains[row] < gain)
            if is_better:
                self._before[k], self._damping[k], chosen[k] = gain, damping[row], count + row
            else:
                self._damping[k] = max(10 * self._damping[k], 100 * options.damping)
            if self._damping[k] <= 1 / _NO_DAMPING:
                left.append(k)
        if min(chosen) == count:
            self.states, self._here, self.steps, self.gains = tried, there, steps, gains
            return left
        self.states = np.concatenate([self.states, tried])[chosen]
        pairs = zip(self._here, there, strict=True)
        both = [None if b is None else np.concatenate([a, b]) for a, b in pairs]
        self._here = Quadratic._make(both).of(chosen)
        self.steps, self.gains = _steps(self._here, self._free, self._damping, options)
        return left

    def _as_shown(self, there: Quadratic, asked: list[int]) -> Quadratic:
        """Models at states that were tried, with what gradients show along the last six steps."""
        curvature, falls = there.curvature.copy(), self._here.gradient[asked] - there.gradient
        for row, (k, fall) in enumerate(zip(asked, falls * self._free, strict=True)):
            if self.gains[k] > self._options.shown_from * abs(float(self._here.value[k])):
                continue
            self._shown[k] = [*self._shown[k][-5:], (self.steps[k], fall)]
            for step, change in self._shown[k]:
                expected = curvature[row] @ step
                along, seen = float(step @ expected), float(step @ change)
                if along <= 0:
                    continue
                share = min((1 - self._options.least_seen) * along / max(along - seen, _TINY), 1.0)
                blend = share * change + (1 - share) * expected
                curvature[row] += blend[:, None] * (blend / (step @ blend))
                curvature[row] -= expected[:, None] * (expected / along)
        return there._replace(curvature=curvature)

    def ended(self, move: Callable[[Any, Floats], Any]) -> Ascent:
        """Where all states are, once the last steps are taken."""
        taken = np.array(self._is_taken)
        values = self._here.value + taken * self.gains
        states = move(self.states, taken[:, None] * self.steps)
        return Ascent(states, values, self._here)


def _steps(
    here: Quadratic, free: Floats, damping: list[float], options: NewtonOptions
) -> tuple[Floats, list[float]]:
    """Damped Newton steps (H, q), and the gains that the models expect of them.

    `free` (q,) is 1 along directions that may change, and 0.
    """
    both = free * free[:, None]
    C, g = here.curvature * both, here.gradient * free
    if here.hessian is not None:
        hessian = here.hessian * both
        rest = hessian - options.least_curvature * C + np.diag(1 - free)
        definite = [dpotrf(one)[1] == 0 for one in rest]
        C = np.where(np.array(definite)[:, None, None], hessian, C)
    return _step(C[0], g[0], damping[0]) if len(g) == 1 else _many_steps(C, g, damping)


def _step(C: Floats, g: Floats, damping: float) -> tuple[Floats, list[float]]:
    """The step (1, q) of one state, and its gain: a quarter of the time of `_many_steps`."""
    step = solved(C, g, damping)
    return step[None], [float(step @ (g - 0.5 * (C @ step)))]


def solved(C: Floats, g: Floats, damping: float) -> Floats:
    """The step (q,) of a model of gradient g (q,) and curvature C (q, q), damped."""
    diagonal = C.diagonal()
    # a direction without curvature must not make the system singular
    floor = _TINY + max(diagonal.tolist()) * 1e-12 * damping
    A = C.copy()
    A.reshape(-1)[:: len(g) + 1] += (damping + 1e-12) * diagonal + floor
    _, step, failure = dposv(A, g)
    return np.asarray(np.linalg.solve(A, g) if failure else step)


def _many_steps(C: Floats, g: Floats, damping: list[float]) -> tuple[Floats, list[float]]:
    """The steps (H, q) of H states, and their gains."""
    diagonal, share = np.einsum("hqq->hq", C), np.array(damping)[:, None]
    top = diagonal.max(axis=1)[:, None]
    A = C + ((share + 1e-12) * diagonal + top * 1e-12 * share + _TINY)[:, None] * np.eye(g.shape[1])
    steps = np.where(top > 0, np.linalg.solve(A, g[..., None])[..., 0], 0.0)
    gains = (steps * (g - 0.5 * (C @ steps[..., None])[..., 0])).sum(axis=1)
    return steps, gains.tolist()

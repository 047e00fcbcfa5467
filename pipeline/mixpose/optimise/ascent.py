"""Terms of an objective, and the damped Newton ascent of their sum from many states at once.

Knows neither images nor poses: a term gives second-order models, and the caller says how steps move
states.  Each state has its damping and its end; those that ended are evaluated no further.  Changes
of the gradient along the last steps correct the curvature of the terms (limited-memory BFGS,
Nocedal, Math. Comp. 35 (1980) 773): with a curvature that is too large in some direction, as that
of mean-shift if offsets are as large as the blur, steps there would get ever smaller.
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
_NO_DAMPING = float(np.sqrt(np.finfo(np.float64).eps))  # damping by its inverse leaves no step


class Quadratic(NamedTuple):
    """Second-order models at H states: value + gᵀδ − ½ δᵀCδ of q numbers."""

    value: Floats  # (H,)
    gradient: Floats  # (H, q)
    curvature: Floats  # (H, q, q), symmetric, positive semidefinite
    hessian: Floats | None = None  # minus the second derivatives (H, q, q); may be indefinite

    def of(self, rows: Any) -> Quadratic:
        """Return the models at chosen states."""
        return Quadratic._make(None if part is None else part[rows] for part in self)


class Term(Protocol):
    """A function of a state, to be maximised: evidence or a prior."""

    def linearise(self, states: Any) -> Quadratic:
        """Return second-order models at H states, which have a leading axis H."""
        ...


@dataclass(frozen=True)
class Sum:
    """The sum of terms, which is a term."""

    terms: tuple[Term, ...]

    def linearise(self, states: Any) -> Quadratic:
        """Return second-order models at H states, with Hessians if all terms have theirs."""
        columns = zip(*[term.linearise(states) for term in self.terms], strict=True)
        pairs = [(column, any(part is None for part in column)) for column in columns]
        return Quadratic._make(None if lacks else np.sum(parts, axis=0) for parts, lacks in pairs)


@dataclass(frozen=True)
class NewtonOptions:
    """Damping and ends of an ascent; a step that meets one of the ends is the last."""

    iterations: int = 30  # most evaluations of a state's model
    tolerance: float = 1e-12  # end: the step is expected to gain less than this share of the value
    damping: float = 1e-4  # first Levenberg-Marquardt damping, as a share of the diagonal
    # relative error of values, as from interpolation, which does not move the zero of the gradient:
    # a step that gains less than this is good if the next is expected to gain even less
    value_error: float = 0.0
    # end: less than this share of the value remains to be gained after the step, as gains shrink by
    # about the same factor from step to step
    remaining: float = 0.0
    negligible: float = 0.0  # end: the step gains less than this, in the unit of the value
    together: bool = False  # states that ended are still evaluated: the term has data for each
    least_curvature: float = constant(
        0.3, "of the curvature: a Hessian that is flatter would lead too far"
    )
    shown_from: float = constant(
        2.5e-3,
        "of the value: gradients along steps that gain less are used, r²/4σ² of a tenth of the "
        "blur; farther away longer steps lead to another maximum",
    )
    least_seen: float = constant(
        0.1, "of the curvature, by gradients along a step (Powell, Math. Program. 14 (1978) 224)"
    )


class Ascent(NamedTuple):
    """The ends of the ascents of H states: their best states."""

    states: Any  # with a leading axis H
    values: Floats  # (H,)
    last: Quadratic  # models at the best evaluated states, before a last step without evaluation

    def of(self, rows: slice) -> Ascent:
        """Return the ascents of chosen states."""
        return Ascent(self.states[rows], self.values[rows], self.last.of(rows))


def ascend(
    term: Term,
    states: Any,  # (H, ...) array
    move: Callable[[Any, Floats], Any],  # the states reached from H states by steps (H, q)
    free: Mask,  # (q,) directions that may change
    options: NewtonOptions = NewtonOptions(),
    at_start: Quadratic | None = None,  # models at the start, if known
) -> Ascent:
    """Climb to a maximum near each of H states."""
    climb = _Climb(states, at_start or term.linearise(states), free, options)
    going = all_states = list(range(len(climb.gains)))
    for _ in range(options.iterations - 1):
        going = climb.unfinished(going)
        if not going:
            break
        evaluated = all_states if options.together else going
        rows = slice(None) if evaluated == all_states else evaluated
        proposed = move(climb.states[rows], climb.steps[rows])
        going = climb.take(proposed, term.linearise(proposed), evaluated, going)
    return climb.ended(move)


def stepped(
    term: Term,
    states: Any,  # H states
    move: Callable[[Any, Floats], Any],  # as for `ascend`
    free: Mask,  # (q,)
    count: int,  # steps
    damping: float = NewtonOptions.damping,
) -> Ascent:
    """Take `count` steps from each of H states, whatever they gain, if only the best will count."""
    can_change, options = free.astype(np.float64), NewtonOptions(damping=damping)
    for _ in range(count):
        models = term.linearise(states)
        steps, gains = _steps(models, can_change, [damping] * len(models.value), options)
        states = move(states, steps)
    return Ascent(states, models.value + gains, models)


class _Climb:
    """States of ascents that go on, with their models and the steps to be tried next."""

    def __init__(self, states: Any, models: Quadratic, free: Mask, options: NewtonOptions) -> None:
        count = len(models.value)
        self.states, self._models, self._options = states, models, options
        self._free = free.astype(np.float64)
        self._damping = [options.damping] * count
        self.steps, self.gains = _steps(models, self._free, self._damping, options)
        self._before = [0.0] * count  # gains of the previous steps
        self._changes: list[list[tuple[Floats, Floats]]] = [[] for _ in range(count)]
        self._is_taken = [False] * count  # whether the last step is taken without evaluation

    def unfinished(self, going: list[int]) -> list[int]:
        """Return the numbers of states that have not arrived."""
        options = self._options
        remaining, values = [], self._models.value.tolist()
        for k in going:
            size, gain = abs(values[k]), self.gains[k]
            is_near = gain**2 <= options.remaining * size * self._before[k]
            if is_near or gain <= max(options.tolerance * size, options.negligible):
                # so near the model is exact: the last step is taken without evaluation
                self._is_taken[k] = True
            else:
                remaining.append(k)
        return remaining

    def take(self, tried: Any, new: Quadratic, asked: list[int], going: list[int]) -> list[int]:
        """Accept better states and damp the other steps; return the numbers of states not stuck."""
        options, values, new_values = self._options, self._models.value.tolist(), new.value.tolist()
        if new.hessian is None:
            new = self._corrected(new, asked)
        count = len(values)
        damping = [max(self._damping[k] / 10, _NO_DAMPING) for k in asked]
        steps, gains = _steps(new, self._free, damping, options)
        chosen, remaining = list(range(count)), []
        for row, k in enumerate(asked):
            if len(going) < len(asked) and k not in going:
                continue
            gain = self.gains[k]
            is_close = gain <= options.value_error * abs(values[k])
            is_better = new_values[row] > values[k] or (is_close and gains[row] < gain)
            if is_better:
                self._before[k], self._damping[k], chosen[k] = gain, damping[row], count + row
            else:
                self._damping[k] = max(10 * self._damping[k], 100 * options.damping)
            if self._damping[k] <= 1 / _NO_DAMPING:
                remaining.append(k)
        if min(chosen) == count:
            self.states, self._models, self.steps, self.gains = tried, new, steps, gains
            return remaining
        self.states = np.concatenate([self.states, tried])[chosen]
        pairs = zip(self._models, new, strict=True)
        both = [None if b is None else np.concatenate([a, b]) for a, b in pairs]
        self._models = Quadratic._make(both).of(chosen)
        self.steps, self.gains = _steps(self._models, self._free, self._damping, options)
        return remaining

    def _corrected(self, new: Quadratic, asked: list[int]) -> Quadratic:
        """Correct models at proposed states by changes of the gradient along the last six steps."""
        curvature, falls = new.curvature.copy(), self._models.gradient[asked] - new.gradient
        for row, (k, fall) in enumerate(zip(asked, falls * self._free, strict=True)):
            if self.gains[k] > self._options.shown_from * abs(float(self._models.value[k])):
                continue
            self._changes[k] = [*self._changes[k][-5:], (self.steps[k], fall)]
            for step, change in self._changes[k]:
                expected = curvature[row] @ step
                along, shown = float(step @ expected), float(step @ change)
                if along <= 0:
                    continue
                share = min((1 - self._options.least_seen) * along / max(along - shown, _TINY), 1.0)
                blend = share * change + (1 - share) * expected
                curvature[row] += blend[:, None] * (blend / (step @ blend))
                curvature[row] -= expected[:, None] * (expected / along)
        return new._replace(curvature=curvature)

    def ended(self, move: Callable[[Any, Floats], Any]) -> Ascent:
        """Take the last steps, and return where all states are."""
        taken = np.array(self._is_taken)
        values = self._models.value + taken * self.gains
        states = move(self.states, taken[:, None] * self.steps)
        return Ascent(states, values, self._models)


def _steps(
    models: Quadratic, free: Floats, damping: list[float], options: NewtonOptions
) -> tuple[Floats, list[float]]:
    """Return damped Newton steps (H, q), and the gains that the models expect.

    `free` (q,) is 1 along directions that may change, else 0.
    """
    both = free * free[:, None]
    C, g = models.curvature * both, models.gradient * free
    if models.hessian is not None:
        hessian = models.hessian * both
        margin = hessian - options.least_curvature * C + np.diag(1 - free)
        definite = [dpotrf(matrix)[1] == 0 for matrix in margin]
        C = np.where(np.array(definite)[:, None, None], hessian, C)
    return _step(C[0], g[0], damping[0]) if len(g) == 1 else _many_steps(C, g, damping)


def _step(C: Floats, g: Floats, damping: float) -> tuple[Floats, list[float]]:
    """Return the step (1, q) of one state, and its gain, four times as fast as `_many_steps`."""
    step = solved(C, g, damping)
    return step[None], [float(step @ (g - 0.5 * (C @ step)))]


def solved(C: Floats, g: Floats, damping: float) -> Floats:
    """Return the damped step (q,) of a model with gradient g (q,) and curvature C (q, q)."""
    diagonal = C.diagonal()
    # directions without curvature must not make the system singular
    floor = _TINY + max(diagonal.tolist()) * 1e-12 * damping
    A = C.copy()
    A.reshape(-1)[:: len(g) + 1] += (damping + 1e-12) * diagonal + floor
    _, step, failure = dposv(A, g)
    return np.asarray(np.linalg.solve(A, g) if failure else step)


def _many_steps(C: Floats, g: Floats, damping: list[float]) -> tuple[Floats, list[float]]:
    """Return the steps (H, q) of H states, and their gains."""
    diagonal, share = np.einsum("hqq->hq", C), np.array(damping)[:, None]
    top = diagonal.max(axis=1)[:, None]
    A = C + ((share + 1e-12) * diagonal + top * 1e-12 * share + _TINY)[:, None] * np.eye(g.shape[1])
    steps = np.where(top > 0, np.linalg.solve(A, g[..., None])[..., 0], 0.0)
    gains = (steps * (g - 0.5 * (C @ steps[..., None])[..., 0])).sum(axis=1)
    return steps, gains.tolist()

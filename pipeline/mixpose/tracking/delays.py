"""How late sensors are: what is told of it, and what frames say of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from mixpose.judgement import Judged
from mixpose.objective import View
from mixpose.records import DelaySeen
from mixpose.rigid import Floats
from mixpose.tracking.in_motion import LEAST_VARIANCE, offsets_of

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData

LONGEST_S = 1.0  # a clock that differs by more is not the same
UNKNOWN_S = 0.1  # standard deviation of a delay of which nothing is known
SOME_FRAMES = 3  # of so many, one is asked for delays that nobody told: it takes time
_ROUNDING = 1e-9


def is_timed(views: Sequence[View]) -> bool:
    """Whether any view is seen at another moment than the common time."""
    return any(view.delay or view.readout or view.unsure is not None for view in views)


@dataclass(frozen=True)
class DelayEvidence:
    """What the frames so far say of how late sensors are, beyond what was told of them.

    Attributes
    ----------
    reference : str
        The sensor against which delays are known; empty before the first frame.
    names : tuple of str
        The others.
    information : (n, n) float64
        Per squared second.
    vector : (n,) float64
        Per second.
    """

    reference: str = ""
    names: tuple[str, ...] = ()
    information: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    vector: Floats = field(default_factory=lambda: np.zeros(0))

    def seconds(self) -> dict[str, DelaySeen]:
        """How late each sensor is, as far as it is known, and how surely."""
        if not self.names:
            return {}
        inverse = np.linalg.inv(self.information + np.eye(len(self.names)) / UNKNOWN_S**2)
        late, deviation = inverse @ self.vector, np.sqrt(inverse.diagonal())
        pairs = zip(self.names, late.tolist(), deviation.tolist(), strict=True)
        return {name: DelaySeen(seconds, sigma) for name, seconds, sigma in pairs}

    def applied(
        self, views: Sequence[View], time_s: float | None, elapsed: float | None
    ) -> list[View]:
        """Views as late as they are known to be by now, at a time and so long after the last pose.

        Without times none is late; where clocks are not the same, none is by what was told.
        """
        if time_s is None:
            return [replace(view, delay=0.0, readout=0.0, unsure=None) for view in views]
        known = self.seconds() if any(view.unsure is not None for view in views) else {}
        applied = list(views)
        for k, view in enumerate(views):
            if view.unsure is not None:
                late = known.get(view.name, DelaySeen(0.0, UNKNOWN_S))
                delay = view.delay + late.seconds
                applied[k] = replace(
                    view, delay=delay, unsure=late.deviation, estimated=late.seconds
                )
        longest = LONGEST_S if elapsed is None else min(max(elapsed, 0.0), LONGEST_S)
        if all(abs(view.delay) <= longest for view in applied):
            return applied
        return [replace(view, delay=0.0) for view in applied]

    def joined(self, data: FrameData, best: Judged) -> DelayEvidence:
        """With one more frame, whose best pose is known as well as its features say."""
        used = [one for one in best.associations if best.sensors[one.name].used]
        is_asked = data.frame % SOME_FRAMES == 0 or is_timed(data.views)
        if len(used) < 2 or not data.elapsed or not is_asked:
            return self
        expected = data.expected(best.T_world_object)
        own = {one.name: k for k, one in enumerate(used)}
        views = [view for view in data.views if view.name in own]
        told = [view.name for view in views if view.unsure is None]
        reference = self.reference or (told[0] if told else "")
        if not expected.gain.any() or reference not in own:
            return self
        names = (*self.names, *(n for n in own if n != reference and n not in self.names))
        seen = offsets_of(data, used)
        late = seen.by_delay(expected.velocity, [own.get(name, -1) for name in names])
        rest = float(seen.offsets @ seen.offsets) / max(len(seen.offsets) - 6, 1)
        variance = max(rest, LEAST_VARIANCE)
        # what a pose and an unknown change of the velocity explain as well says nothing of delays
        shifts = seen.rows * seen.late[:, None] * expected.deviation / np.sqrt(variance)
        free = np.block([[seen.rows, shifts], [np.zeros((6, 6)), np.eye(6)]])
        free /= np.maximum(np.linalg.norm(free, axis=0), np.finfo(float).tiny)
        columns = np.pad(late, ((0, 6), (0, 0)))
        columns -= free @ np.linalg.lstsq(free, columns, rcond=_ROUNDING)[0]
        information = columns.T @ columns / variance
        estimated = {view.name: view.estimated for view in views}
        vector = columns[: len(late)].T @ seen.offsets / variance
        vector += information @ np.array([estimated.get(name, 0.0) for name in names])
        n = len(self.names)
        information[:n, :n] += self.information
        vector[:n] += self.vector
        return DelayEvidence(reference, names, information, vector)

"""Odds from the number of false detections, given the numbers in earlier frames.

Of the M detections of a frame M − n are false where a pose meets n of them, and all M without the
body.  Their number is Poisson distributed, with a rate of the Gamma distribution (c + ½, T) after c
in T frames; or, where something new came into view, with the rate M that the frame itself shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mixpose.matching import Matches


@dataclass(frozen=True)
class ClutterRates:
    """False detections in earlier frames, all of which are sure of the body's pose."""

    # by sensor: the number of false detections, and of frames
    seen: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def followed(self, used: Matches, memory: float) -> ClutterRates:
        """Return the counts with those of one more frame; earlier ones fade by `memory`."""
        seen = dict(self.seen)
        for name, count, met in zip(used.names, used.count.tolist(), used.met.tolist()):
            false, frames = seen.get(name, (0.0, 0.0))
            seen[name] = memory * false + max(count - met, 0.0), memory * frames + 1
        return ClutterRates(seen)

    def log_odds(self, used: Matches, log_new: float) -> float:
        """Return the log odds, by the number of detections, of the body against clutter alone.

        `log_new` is the log probability that something new came into view, so that the rate is that
        of the frame itself.
        """
        with_body, alone = 0.0, 0.0
        images = used.images[used.owner]  # a cloud has three, all of the same points
        rows = zip(used.names, used.count.tolist(), used.met.tolist(), images.tolist())
        for name, count, met, shown in rows:
            if name in self.seen and count > 0:
                with_body += self._log_ratio(name, max(count - met, 0.0), count) / shown
                alone += self._log_ratio(name, count, count) / shown
        if with_body == alone:
            return 0.0
        odds = np.logaddexp([with_body, alone], log_new - math.log1p(-math.exp(log_new)))
        return float(odds[0] - odds[1])

    def _log_ratio(self, name: str, number: float, rate: float) -> float:
        """Return the log ratio of the probabilities of a number by earlier frames and by a rate."""
        false, frames = self.seen[name]
        shape = false + 0.5
        log_chance = math.lgamma(number + shape) - math.lgamma(shape)
        log_chance += shape * math.log(frames / (frames + 1))
        return log_chance - number * math.log((frames + 1) * rate) + rate

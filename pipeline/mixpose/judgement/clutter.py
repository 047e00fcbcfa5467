"""How many detections belong to nothing, as the frames before tell it.

Of the M detections of a frame the body leaves M − n to clutter, which without it has all of them.
Their number is Poisson's, of a rate with the Gamma distribution (c + ½, T) of which T frames have
shown c; or, where a frame shows what is new, of the rate M at which it shows them itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mixpose.matching import Matches


@dataclass(frozen=True)
class ClutterRates:
    """What sensors saw beside the body in the frames before, all of which are sure of it."""

    # by sensor: detections that belonged to nothing, and frames
    seen: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def followed(self, used: Matches, memory: float) -> ClutterRates:
        """With what is left of one more frame; of those before it `memory` is kept."""
        seen = dict(self.seen)
        for name, count, met in zip(used.names, used.count.tolist(), used.met.tolist()):
            left, frames = seen.get(name, (0.0, 0.0))
            seen[name] = memory * left + max(count - met, 0.0), memory * frames + 1
        return ClutterRates(seen)

    def log_odds(self, used: Matches, log_new: float) -> float:
        """By how much likelier the number of detections is with the body than of clutter alone.

        Beyond what clutter of the rate that the frame itself shows makes of it, which counts where
        something is new: `log_new` is the log of how often that is.
        """
        with_body, alone = 0.0, 0.0
        images = used.images[used.owner]  # a cloud has three, which show the same
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
        """Of the chances of a number of false detections: of what was seen, to that of a rate."""
        left, frames = self.seen[name]
        shape = left + 0.5
        told = math.lgamma(number + shape) - math.lgamma(shape)
        told += shape * math.log(frames / (frames + 1))
        return told - number * math.log((frames + 1) * rate) + rate

"""Errors that last: fields by which the features of a sensor are off in all frames alike.

Of fields, columns P of sizes γ in σ_ε, the residuals r of a frame have the information PᵀWRP and
the vector PᵀWr, with R what a pose leaves of errors.  With their fading sums A and v, and γ normal
with the deviation d before, γ̂ = S v, S = (A + 1/d²)⁻¹: where vᵀγ̂ is larger than chance makes it,
something lasts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from mixpose.constants import constant
from mixpose.records import Floats


@dataclass(frozen=True)
class BiasRules:
    """What is believed of errors that last."""

    deviation: float = constant(
        0.25, "σ_ε: of fields that last, once some are seen: 0.4 px, a camera turned by 0.02°"
    )
    memory: float = constant(0.99, "per frame, of what was seen before: 100 frames count")
    rigs: int = constant(4, "sets of sensors that are told apart, the last ones that were seen")


@dataclass(frozen=True)
class PersistentBias:
    """What the frames so far say of fields that last."""

    names: tuple[str, ...]  # sensors that took part in these frames
    information: Floats  # (q, q) about the fields of all of them, per σ_ε²
    vector: Floats  # (q,) per σ_ε

    def after(
        self, before: Sequence[PersistentBias], rules: BiasRules
    ) -> tuple[PersistentBias, ...]:
        """The frame with what the same sensors showed before it, then what other sensors did."""
        information, vector = self.information, self.vector
        others = [one for one in before if one.names != self.names]
        for one in before:
            if one.names == self.names and len(one.vector) == len(self.vector):
                information = rules.memory * one.information + information
                vector = rules.memory * one.vector + vector
        return (PersistentBias(self.names, information, vector), *others[: rules.rigs - 1])

    def sizes(self, rules: BiasRules, by_chance: float) -> tuple[Floats, Floats] | None:
        """Fields γ̂ (q,) in σ_ε and their second moments (q, q); None where there may be none.

        `by_chance` is the share of frames that show as little where nothing lasts.
        """
        if not rules.deviation:
            return None
        S = np.linalg.inv(self.information + np.eye(len(self.vector)) / rules.deviation**2)
        sizes = S @ self.vector
        degrees = float((S * self.information).sum())
        if self.vector @ sizes <= chdtri(max(degrees, 1.0), 1 - by_chance):
            return None
        return sizes, np.asarray(S + np.outer(sizes, sizes))

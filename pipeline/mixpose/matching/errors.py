"""ε, what the extraction errs by: how large it is, as offsets of features show it.

At a blur σ a feature r away from its prediction pulls with r exp(−r²/4σ²), as in robust least
squares with the loss of Welsch.  Offsets of standard deviation s, weighted so, have the variance q
with 1/q = 1/s² + 1/2σ².  σ = 1.5 s and s² = q / (1 − q / 2σ²) follow from one another, from σ_ε
down and from what is known upwards, to where they agree.  Lengths are in σ_ε of their sensor.
Of noise, squares of residuals and degrees of freedom are added up (2, L): sensor by sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mixpose.constants import constant
from mixpose.density import DRAWING
from mixpose.matching.matches import Matches
from mixpose.records import Floats


@dataclass(frozen=True)
class ErrorRules:
    """What is believed of the extraction's error before offsets are seen."""

    typical: float = constant(
        0.2, "of σ_ε: centres of blobs err by 0.01-0.3 px where sigma is 1.5 px (recordings)"
    )
    typical_degrees: float = constant(
        4.0, "degrees of freedom that `typical` counts as, and all sensors for one: two features"
    )
    blur: float = constant(1.5, "of the noise: Welsch's loss is then 95 % as efficient as squares")
    narrowest: float = constant(
        0.05, "of σ_ε, blur of the last look: what centres of blobs err by at best (0.03 σ_ε)"
    )
    astray: float = constant(
        0.1, "chance that an offset within `met` is no noise: a spot cut, merged or another's"
    )
    met: float = constant(
        3.0, "σ_ε within which a detection may be a feature's: it pulls with a tenth beyond"
    )
    outlying: float = constant(
        3.5, "standard deviations from which an offset is no noise: by chance 2 in 1000 are beyond"
    )

    @property
    def reach(self) -> float:
        """σ_ε around features within which detections count: as far as C is drawn, and `met`."""
        return math.sqrt(2) * DRAWING.reach + self.met


LEAST_VARIANCE = float(np.finfo(np.float32).eps)
"""In σ_ε²: densities of single precision do not resolve smaller offsets."""


class NoiseEstimate(NamedTuple):
    """What offsets show."""

    own: Floats  # (2, L) squares, in σ_ε², and degrees of freedom of each sensor in this frame
    variances: Floats  # (L,) of each sensor's noise, together with what was known
    blurs: Floats  # (L,) in σ_ε
    before: Floats  # (L,) blurs by what was known of the noise before the frame


def errors_seen(
    matches: Matches, free: int, known: Floats, rules: ErrorRules = ErrorRules()
) -> NoiseEstimate:
    """How large errors are, of matches at a pose fitted to them in so many free directions.

    `known` (2, L) has the squares and degrees of freedom of each sensor's noise so far.
    """
    before = _blurs(pooled(known, rules, rules.typical_degrees), matches, rules)
    given = before, matches, free, known, rules
    blurs = np.ones(len(before))
    while True:
        seen = _seen_at(blurs, *given)
        if (seen.blurs > 0.9 * blurs).all():
            break
        blurs = np.minimum(seen.blurs, blurs)
    if (seen.blurs <= 1.2 * before).all():
        return seen
    blurs = before
    for _ in range(4):  # as a rule it takes one or two
        narrow = _seen_at(blurs, *given)
        if (narrow.blurs <= 1.2 * blurs).all():
            break
        blurs = narrow.blurs
    return max(seen, narrow, key=lambda one: log_likelihood(one.blurs, matches, free, rules))


def _blurs(variances: Floats, matches: Matches, rules: ErrorRules) -> Floats:
    """Blurs (L,) that suit a noise."""
    return np.minimum(np.maximum(rules.blur * np.sqrt(variances), matches.finest), 1.0)


def _seen_at(
    blurs: Floats, before: Floats, matches: Matches, free: int, known: Floats, rules: ErrorRules
) -> NoiseEstimate:
    """The same, as seen at one blur (L,) for each sensor."""
    squared, m, squares = matches.squared, matches.dimensions, blurs * blurs
    weights = matches.shares * np.exp(squared * (-0.25 / squares)[:, None])
    coordinates = m * weights.sum(axis=1) + 1e-12
    q = (weights * squared).sum(axis=1) / coordinates
    # at most twice what is seen: wider than the blur, offsets do not tell how wide they are
    factor = 1 / (1 - np.minimum(0.5 * q / squares, 0.5))
    # normal offsets weigh (1 + s²/2σ²)^(-m/2) on average
    degrees = factor ** (m / 2) * coordinates
    most = float(degrees.sum())
    # shares do not add up to whole ones: half a degree of freedom is none
    left = 1 - free / most if most - free > 0.5 else 0.0
    own = np.array([factor * q * degrees if left else 0.0 * q, degrees * left])
    variances = pooled(known + own, rules, rules.typical_degrees)
    # narrower only where this frame alone allows it, too: it may not be like those before it
    wide = np.maximum(variances, pooled(own, rules, 0.0))
    # half way to all sensors': what calibrations err by is in no sensor's own noise
    wide = (wide + float(wide @ coordinates) / float(coordinates.sum())) / 2
    return NoiseEstimate(own, variances, _blurs(wide, matches, rules), before)


def log_likelihood(
    blurs: Floats, matches: Matches, free: int, rules: ErrorRules = ErrorRules()
) -> float:
    """Of offsets, normal ones and some that are anywhere, less that of none being noise.

    What a pose is free to fit is paid for.  Blurs (L,) go by the noise.
    """
    m, variances = matches.dimensions[:, None], (blurs[:, None] / rules.blur) ** 2
    peaks = (2 * np.pi * variances) ** (-0.5 * m)
    anywhere = np.where(m == 1, 2 * rules.met, np.pi * rules.met**2)
    odds = (1 / rules.astray - 1) * anywhere * peaks * np.exp(-0.5 * matches.squared / variances)
    believed = m * matches.shares * odds / (1 + odds)
    logs = believed * np.log(2 * np.pi * variances)
    price = 0.5 * free * float(logs.sum()) / max(float(believed.sum()), 1e-12)
    return float((matches.shares * np.log1p(odds)).sum()) + price


def pooled(sums: Floats, rules: ErrorRules, typical: float) -> Floats:
    """Variances (L,) of squares and degrees of freedom (2, L), each drawn to that of all sensors.

    In that the typical variance counts as `typical` degrees of freedom.
    """
    squares, degrees = sums
    total_squares, total_degrees = sums.sum(axis=1).tolist()
    most = total_degrees + typical
    common = (total_squares + typical * rules.typical**2) / max(most, 1e-12)
    pull = min(rules.typical_degrees, most)
    variances = (squares + pull * common) / np.maximum(degrees + pull, 1e-12)
    return np.asarray(np.maximum(variances, LEAST_VARIANCE))

"""Which frames are calibrated from, and which are held back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mixpose.calibration.rules import CalibrationRules

_RUN = 4  # frames held back together where motion between them counts


def held_back(count: int, rules: CalibrationRules, *, runs: bool) -> NDArray[np.bool_]:
    """Which of `count` frames are held back: every fifth, or every fifth run of four."""
    mask = np.zeros(count, dtype=np.bool_)
    most = min(int(rules.held_back * count + 0.5), count - rules.least_frames)
    if most < 1:
        return mask
    period = round(1 / rules.held_back)
    if runs and count >= _RUN * period:
        return np.asarray((np.arange(count) // _RUN) % period == period // 2)
    mask[period // 2 :: period] = True
    return mask

"""Which frames are calibrated from, which are held back, and which are bad."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats

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


def chosen(information: Floats, most: int) -> NDArray[np.intp]:
    """Greedily the frames that add most information (D-optimal), in their order.

    Parameters
    ----------
    information : (K, G, G) array
        Of each frame, in comparable units.
    most : int
    """
    count, G, _ = information.shape
    if count <= most:
        return np.arange(count)
    total = np.eye(G) * 1e-6 * max(float(np.trace(information.mean(axis=0))), 1e-12) / max(G, 1)
    left = np.ones(count, dtype=np.bool_)
    order = []
    for _ in range(most):
        gains = np.full(count, -np.inf)
        candidates = np.flatnonzero(left)
        gains[candidates] = np.linalg.slogdet(total + information[candidates])[1]
        best = int(np.argmax(gains))
        order.append(best)
        left[best] = False
        total = total + information[best]
    return np.sort(np.array(order, dtype=np.intp))

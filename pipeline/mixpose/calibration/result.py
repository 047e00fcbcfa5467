"""What a calibration found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.rig import Block, Rig
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats


@dataclass(frozen=True)
class Residual:
    """Root mean square residuals of one sensor, sensor units; NaN without any."""

    before: float  # with the calibration before and after
    after: float
    held: float  # of every frame, with the calibration that the others tell: that of new data


@dataclass(frozen=True, eq=False)
class Sights:
    """All that one sensor saw and met, for pictures and lists."""

    y: Floats  # (n, m): detections that were met
    offset: Floats  # (n, m): detected minus predicted, after
    frame: NDArray[np.intp]  # (n,): frame numbers
    feature: NDArray[np.intp]  # (n,)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration with all that tells whether to trust it."""

    before: Rig
    after: Rig
    blocks: tuple[Block, ...]
    # (G,): one standard deviation of each free parameter; infinite where not determined
    deviations: Floats
    covariance: Floats  # (G, G)
    refused: tuple[str, ...]  # directions that the data do not determine; they stay as they were
    gauge: tuple[str, ...]  # freedoms of the rig that were removed
    through: Mapping[int, tuple[int | None, int]]
    unlinked: tuple[int, ...]
    used: tuple[int, ...]  # frame numbers: calibrated from; left out as bad
    bad: tuple[int, ...]
    recorded: int  # frames of the recording with detections
    residuals: Mapping[int, Residual]
    noise: Floats  # (L,)
    inflation: float
    # share of the weight of pairs of which each is the nearest that the other has: near 1, or
    # detections cannot be told apart
    certainty: float
    # (G,): standard deviations that biases of ranges as large as σ_ε would add, where they are held
    # and nothing is stated of them
    moved_by_biases: Floats
    # (L,): share of what each sensor could show that is met, weighted as in the objective; NaN
    # without
    explained: Floats
    sights: Mapping[int, Sights]
    poses: Mapping[int, Floats]  # (4, 4) each: by frame number
    frames: tuple[SeenFrame, ...]

    def doubtful(self, rules: CalibrationRules) -> tuple[int, ...]:
        """Sensors that most likely stand elsewhere: what they saw is not explained."""
        return tuple(int(s) for s in np.flatnonzero(self.explained < rules.explained))

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
    """Root mean square residuals of one sensor, sensor units; NaN without any.

    Attributes
    ----------
    before, after : float
        With the calibration before and after.
    held : float
        Of every frame, with the calibration that the others tell: that of new data.
    """

    before: float
    after: float
    held: float


@dataclass(frozen=True, eq=False)
class Sights:
    """All that one sensor saw and met, for pictures and lists.

    Attributes
    ----------
    y : (n, m) float64
        Detections that were met.
    offset : (n, m) float64
        Detected minus predicted, after.
    frame : (n,) int
        Frame numbers.
    feature : (n,) int
    """

    y: Floats
    offset: Floats
    frame: NDArray[np.intp]
    feature: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration with all that tells whether to trust it.

    Attributes
    ----------
    before, after : Rig
    blocks : tuple of Block
    deviations : (G,) float64
        One standard deviation of each free parameter; infinite where not determined.
    covariance : (G, G) float64
    refused : tuple of str
        Directions that the data do not determine; they stay as they were.
    gauge : tuple of str
        Freedoms of the rig that were removed.
    through : mapping of int to (int or None, int)
    unlinked : tuple of int
    used, bad : tuple of int
        Frame numbers: calibrated from; left out as bad.
    recorded : int
        Frames of the recording with detections.
    residuals : mapping of int to Residual
    noise : (L,) float64
    inflation : float
    certainty : float
        Share of the weight of pairs of which each is the nearest that the other has: near 1, or
        detections cannot be told apart.
    moved_by_biases : (G,) float64
        Standard deviations that biases of ranges as large as σ_ε would add, where they are held and
        nothing is stated of them.
    explained : (L,) float64
        Share of what each sensor could show that is met, weighted as in the objective; NaN without.
    sights : mapping of int to Sights
    poses : mapping of int to (4, 4) float64
        By frame number.
    frames : tuple of SeenFrame
    """

    before: Rig
    after: Rig
    blocks: tuple[Block, ...]
    deviations: Floats
    covariance: Floats
    refused: tuple[str, ...]
    gauge: tuple[str, ...]
    through: Mapping[int, tuple[int | None, int]]
    unlinked: tuple[int, ...]
    used: tuple[int, ...]
    bad: tuple[int, ...]
    recorded: int
    residuals: Mapping[int, Residual]
    noise: Floats
    inflation: float
    certainty: float
    moved_by_biases: Floats
    explained: Floats
    sights: Mapping[int, Sights]
    poses: Mapping[int, Floats]
    frames: tuple[SeenFrame, ...]

    def doubtful(self, rules: CalibrationRules) -> tuple[int, ...]:
        """Sensors that most likely stand elsewhere: what they saw is not explained."""
        return tuple(int(s) for s in np.flatnonzero(self.explained < rules.explained))

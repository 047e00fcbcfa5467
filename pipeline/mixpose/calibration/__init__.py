"""Calibration: the objective maximised over sensors and body, without correspondences.

detections  →  each camera alone (hypotheses)  →  links between sensors  →  start of all poses
→  rig and poses together, through narrowing blurs (least squares with soft pairs)
→  what is determined, how well, and whether frames held back agree
"""

from __future__ import annotations

from mixpose.calibration.calibrate import calibrate
from mixpose.calibration.result import Calibration, Residual
from mixpose.calibration.rig import Rig
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import SeenFrame, Task
from mixpose.calibration.words import free_parameters

__all__ = [
    "Calibration",
    "CalibrationRules",
    "Residual",
    "Rig",
    "SeenFrame",
    "Task",
    "calibrate",
    "free_parameters",
]

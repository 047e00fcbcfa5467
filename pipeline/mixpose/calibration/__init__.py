"""Calibration: maximise the objective over sensors and body, without correspondences.

detections  →  poses by all sensors together, if they stand about where the session has them
            or by each camera alone (hypotheses), which link the cameras  →  start of all poses
→  rig and poses adjusted together, at narrowing blurs (least squares with soft pairs)
→  what is determined, how well, and whether frames held back agree
"""

from mixpose.calibration.calibrate import calibrate as calibrate
from mixpose.calibration.result import Calibration as Calibration, Residual as Residual
from mixpose.calibration.rig import Rig as Rig
from mixpose.calibration.rules import CalibrationRules as CalibrationRules
from mixpose.calibration.task import SeenFrame as SeenFrame, Task as Task
from mixpose.calibration.words import free_parameters as free_parameters

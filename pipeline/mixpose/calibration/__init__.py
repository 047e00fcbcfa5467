"""Calibration: the objective maximised over sensors and body, without correspondences.

detections  →  all sensors together, where they stand about as told  →  start of all poses
            or each camera alone (hypotheses)  →  links between sensors  →  start of all poses
→  rig and poses together, through narrowing blurs (least squares with soft pairs)
→  what is determined, how well, and whether frames held back agree
"""

from mixpose.calibration.calibrate import calibrate as calibrate
from mixpose.calibration.result import Calibration as Calibration, Residual as Residual
from mixpose.calibration.rig import Rig as Rig
from mixpose.calibration.rules import CalibrationRules as CalibrationRules
from mixpose.calibration.task import SeenFrame as SeenFrame, Task as Task
from mixpose.calibration.words import free_parameters as free_parameters

"""What planned systems will achieve: predicted accuracy, confirmed by simulation, and advice."""

from mixpose.design.advice import best_marker_move as best_marker_move
from mixpose.design.advice import best_new_sensor as best_new_sensor
from mixpose.design.advice import noise_to_equal as noise_to_equal
from mixpose.design.confirmation import Confirmation as Confirmation, confirm as confirm
from mixpose.design.prediction import Plan as Plan, plan_of as plan_of, predict as predict
from mixpose.design.study import Request as Request, spread_poses as spread_poses, study as study

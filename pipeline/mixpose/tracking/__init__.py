"""Tracking: propose, fit, judge, decide, follow, from frame to frame."""

from mixpose.tracking.clouds import (
    plane_names as plane_names,
    plane_views as plane_views,
    with_clouds as with_clouds,
)
from mixpose.tracking.doubt import CHANGED as CHANGED, TWICE as TWICE
from mixpose.tracking.labels import labelled as labelled
from mixpose.tracking.prediction import PosePredictor as PosePredictor
from mixpose.tracking.refinements import OUT_OF_STEP as OUT_OF_STEP
from mixpose.tracking.rules import Rules as Rules
from mixpose.tracking.scene import (
    Expectation as Expectation,
    Scene as Scene,
    WindowedScene as WindowedScene,
)
from mixpose.tracking.track import (
    Branch as Branch,
    Companion as Companion,
    DelayEvidence as DelayEvidence,
    Track as Track,
    predict as predict,
)
from mixpose.tracking.tracker import Tracker as Tracker, estimate_pose as estimate_pose

"""Tracking: propose, fit, judge, decide, follow, from frame to frame."""

from __future__ import annotations

from mixpose.body import ASIDE as ASIDE
from mixpose.tracking.explain import Explanation as Explanation
from mixpose.tracking.explain import explain as explain
from mixpose.tracking.gating import Expectation as Expectation
from mixpose.tracking.gating import WindowedScene as WindowedScene
from mixpose.tracking.gating import are_as_good as are_as_good
from mixpose.tracking.gating import have_fewer as have_fewer
from mixpose.tracking.gating import is_convincing as is_convincing
from mixpose.tracking.rules import Rules as Rules
from mixpose.tracking.scene import Scene as Scene
from mixpose.tracking.scene import Tracker as Tracker
from mixpose.tracking.scene import estimate_pose as estimate_pose
from mixpose.tracking.track import UNKNOWN_S as UNKNOWN_S
from mixpose.tracking.track import Branch as Branch
from mixpose.tracking.track import Companion as Companion
from mixpose.tracking.track import Track as Track
from mixpose.tracking.track import predict as predict

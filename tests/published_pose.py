"""A pose to be published, and the header of its run."""

from __future__ import annotations

import numpy as np

from mixpose.poses.header import Header
from mixpose.records import Estimate
from mixpose.rigid import from_rotation_vector

HEADER = Header("mm", None, None, "0", 0, objects={"tool": 1})
POSE = from_rotation_vector([0.1, 0.2, 0.3], [10.0, 20.0, 30.0])
ESTIMATE = Estimate(7, 0.25, "tool", "ok", POSE, np.diag(np.arange(1.0, 7.0)), 0.9, {})

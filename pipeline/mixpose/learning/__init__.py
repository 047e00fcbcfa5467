"""Learning: marker coordinates of bodies from a recording in which they move.

detections  →  points in space of each frame, ghosts among them  →  without what stands still
→  points of one frame that lie alike in others  →  found in all frames, with all that goes along
→  markers and poses adjusted together by what calibrates sensors  →  a frame for the body
"""

from __future__ import annotations

from mixpose.learning.adjusting import Eyes, Learnt
from mixpose.learning.axes import Likeness, body_of, by_markers, like
from mixpose.learning.learn import Lesson, learn, learn_from
from mixpose.learning.rules import LearningRules

__all__ = [
    "Eyes",
    "LearningRules",
    "Learnt",
    "Lesson",
    "Likeness",
    "body_of",
    "by_markers",
    "learn",
    "learn_from",
    "like",
]

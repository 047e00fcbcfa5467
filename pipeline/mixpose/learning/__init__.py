"""Learning: marker coordinates of bodies from a recording in which they move.

detections  →  points in space of each frame, ghosts among them  →  without what stands still
→  points of one frame that lie alike in others  →  found in all frames, with all that goes along
→  markers and poses adjusted together by what calibrates sensors  →  a frame for the body
"""

from mixpose.learning.adjusting import Eyes as Eyes, Learnt as Learnt
from mixpose.learning.axes import Likeness as Likeness
from mixpose.learning.axes import by_markers as by_markers, like as like
from mixpose.learning.learn import Lesson as Lesson, learn as learn, learn_from as learn_from
from mixpose.learning.rules import LearningRules as LearningRules

"""Learning: marker coordinates of bodies from a recording in which they move.

detections  →  points in space of each frame, with ghosts  →  without points that stand still
→  points of one frame that lie alike in others  →  placements in all frames, and further points
→  markers and poses adjusted together, as in a calibration  →  axes of the body
"""

from mixpose.learning.adjusting import LearntBody as LearntBody, SensorSet as SensorSet
from mixpose.learning.axes import in_marker_axes as in_marker_axes, in_axes_of as in_axes_of
from mixpose.learning.learn import LearningResult as LearningResult
from mixpose.learning.learn import learn as learn, learn_from as learn_from

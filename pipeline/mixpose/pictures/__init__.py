"""Pictures of frames and poses, to tune an extraction by looking and to trust a pose."""

from mixpose.pictures.canvas import displayable as displayable
from mixpose.pictures.overlay import Part as Part, draw_pose as draw_pose

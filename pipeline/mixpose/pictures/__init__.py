"""Pictures of frames and poses, to tune an extraction by looking and to trust a pose."""

from __future__ import annotations

from mixpose.pictures.canvas import displayable
from mixpose.pictures.overlay import Part, draw_pose

__all__ = ["Part", "displayable", "draw_pose"]

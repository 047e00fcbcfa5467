"""Several bodies in one scene: who explains which detection, and which identical one is which."""

from __future__ import annotations

from mixpose.scene.members import Member
from mixpose.scene.rules import SceneRules
from mixpose.scene.scene import Outcome, Scene

__all__ = ["Member", "Outcome", "Scene", "SceneRules"]

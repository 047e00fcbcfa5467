"""Several bodies in one scene: who explains which detection, and which identical one is which."""

from __future__ import annotations

from mixpose.scene.scene import Member, Outcome, Scene

__all__ = ["Member", "Outcome", "Scene"]

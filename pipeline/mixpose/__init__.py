"""mixpose: 6-D poses of a known rigid body from raw frames, without matching markers.

import mixpose

session = mixpose.load_session("session.toml")
for estimate in mixpose.run(session):
    print(estimate.frame, estimate.status, estimate.T_world_object)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from mixpose.body import Body, PointFeature, SegmentFeature
    from mixpose.density import Observation
    from mixpose.errors import MixposeError, RecordingError, SessionError
    from mixpose.objective import View
    from mixpose.records import Estimate
    from mixpose.runner import run
    from mixpose.selection import Selection
    from mixpose.session import Session, load_session
    from mixpose.tracking import estimate_pose

_HOMES = {
    "Body": "mixpose.body",
    "Estimate": "mixpose.records",
    "MixposeError": "mixpose.errors",
    "Observation": "mixpose.density",
    "PointFeature": "mixpose.body",
    "RecordingError": "mixpose.errors",
    "SegmentFeature": "mixpose.body",
    "Selection": "mixpose.selection",
    "Session": "mixpose.session",
    "SessionError": "mixpose.errors",
    "View": "mixpose.objective",
    "estimate_pose": "mixpose.tracking",
    "load_session": "mixpose.session",
    "run": "mixpose.runner",
}

__all__ = [
    "Body",
    "Estimate",
    "MixposeError",
    "Observation",
    "PointFeature",
    "RecordingError",
    "SegmentFeature",
    "Selection",
    "Session",
    "SessionError",
    "View",
    "__version__",
    "estimate_pose",
    "load_session",
    "run",
]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that importing mixpose stays cheap."""
    if name in _HOMES:
        from importlib import import_module  # noqa: PLC0415

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'mixpose' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

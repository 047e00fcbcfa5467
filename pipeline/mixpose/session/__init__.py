"""The session file: one TOML file that holds a whole set-up."""

from __future__ import annotations

from mixpose.session.reader import load_scene, load_session
from mixpose.session.setup import ObjectSetup, SensorSetup, Session, Start

__all__ = ["ObjectSetup", "SensorSetup", "Session", "Start", "load_scene", "load_session"]

"""A session file from the calibration and body files of other programs."""

from __future__ import annotations

from mixpose.importing.gather import Imported, gather, session_text

__all__ = ["Imported", "gather", "session_text"]

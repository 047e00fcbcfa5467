"""Frames: raw recordings as streams, joined by frame number.

`open_source` finds and opens what a session names; `pair` joins the sources of all sensors.
"""

from mixpose.frames.images import read_image
from mixpose.frames.opening import files_of, open_source
from mixpose.frames.pairing import pair
from mixpose.frames.prefetch import prefetch
from mixpose.frames.source import ALL_NUMBERS, SensorKind, Source, SourceSpec
from mixpose.frames.pairing import paired_by_stamp

__all__ = [
    "ALL_NUMBERS",
    "SensorKind",
    "Source",
    "SourceSpec",
    "files_of",
    "open_source",
    "pair",
    "paired_by_stamp",
    "prefetch",
    "read_image",
]

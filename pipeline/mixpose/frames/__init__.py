"""Read raw recordings as streams of frames, joined by frame number.

`open_source` finds and opens what a session names; `pair` joins the sources of all sensors.
"""

from mixpose.frames.images import ImageSequence as ImageSequence, read_image as read_image
from mixpose.frames.opening import (
    files_of as files_of,
    numbers_of as numbers_of,
    open_source as open_source,
    spread_over as spread_over,
)
from mixpose.frames.pairing import pair as pair, paired_by_stamp as paired_by_stamp
from mixpose.frames.pairing import prefetch as prefetch
from mixpose.frames.source import ALL_NUMBERS as ALL_NUMBERS, SensorKind as SensorKind
from mixpose.frames.source import Source as Source, SourceSpec as SourceSpec

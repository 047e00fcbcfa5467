"""NDI's .rom (SROM): a binary file of 752 bytes with up to 20 markers, in mm.

Little-endian: "NDI", a checksum at byte 4 (the sum of all bytes after it), the number of markers at
byte 28, positions as three float32 each from byte 72.
"""

from __future__ import annotations

import struct

import numpy as np

from mixpose.session.markers import Markers
from mixpose.session.messages import BadKeyError

NDI_MARK = b"NDI\0"
_CHECKSUM, _SUMMED_FROM, _COUNT, _POSITIONS = 4, 6, 28, 72
_MOST = 20


def read_rom(content: bytes) -> Markers:
    """Read the markers of an NDI tool.

    Raises BadKeyError if the file is none, is cut short, or has changed since it was written.
    """
    if not content.startswith(NDI_MARK):
        raise BadKeyError('not an NDI .rom file, which begins with "NDI"')
    if len(content) < _POSITIONS + 12 * _MOST:
        raise BadKeyError(f"found {len(content)} bytes; an NDI .rom file has 752: it is cut short")
    (stated,) = struct.unpack_from("<H", content, _CHECKSUM)
    if sum(content[_SUMMED_FROM:]) & 0xFFFF != stated:
        raise BadKeyError("its checksum is wrong: the file is damaged; export it again")
    (count,) = struct.unpack_from("<I", content, _COUNT)
    if not 1 <= count <= _MOST:
        raise BadKeyError(f"found {count} markers; allowed: 1 to {_MOST}")
    positions = np.frombuffer(content, "<f4", 3 * count, _POSITIONS).reshape(count, 3)
    return Markers(positions.astype(np.float64), None, tuple("ABCDEFGHIJKLMNOPQRST"[:count]))

"""When the frames of live sources were captured, by the clock of this machine."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mixpose.constants import constant
from mixpose.frames.capture import is_device
from mixpose.records import Moment

# RTP and MPEG transport streams carry the sender's clock; multipart JPEG and bare streams do not,
# and FFmpeg makes their stamps up from a nominal rate
_STAMPED = ("rtsp://", "rtsps://", "rtp://", "rtmp://", "srt://", "udp://")


@dataclass(frozen=True)
class ClockRules:
    """What is believed of the clocks of cameras."""

    drift: float = constant(1e-4, "by which clocks of cameras differ at most: quartz errs by 5e-5")
    longest_s: float = constant(
        1.0, "from capture to arrival: stamps that are later are of another clock than they were"
    )


class CaptureTimes:
    """Tells from the stamps of a live source when its frames were captured.

    A camera at this machine (V4L2) stamps frames by the machine's own clock. Stamps of a stream are
    of a clock that is off by an unknown time; as no frame arrives before it was captured, the least
    difference seen so far is taken for it (E. Olson, *A Passive Solution to the Sensor
    Synchronization Problem*, IROS 2010). Moments are then late by the shortest transmission, and
    free of what others took longer.
    """

    def __init__(self, address: str | int, rules: ClockRules = ClockRules()) -> None:
        self._is_device = isinstance(address, int) or is_device(address)
        self._has_stamps = self._is_device or str(address).lower().startswith(_STAMPED)
        self._rules = rules
        self._last: tuple[float, float] | None = None  # stamp, and least difference

    def moment(self, stamp_s: float, arrived: float | None = None) -> Moment:
        """When a frame was captured that arrived, now if not said, with a stamp in seconds."""
        arrived = time.monotonic() if arrived is None else arrived
        last, self._last = self._last, None
        if not self._has_stamps or not stamp_s > (0.0 if last is None else last[0]):
            return Moment(arrived, "arrival")
        off = arrived - stamp_s
        if self._is_device and 0 <= off < self._rules.longest_s:
            return Moment(stamp_s, "capture")
        if last is not None and off - last[1] < self._rules.longest_s:
            off = min(off, last[1] + self._rules.drift * (stamp_s - last[0]))
        self._last = stamp_s, off
        return Moment(stamp_s + off, "capture")

"""Remarks to people on standard error, a line each."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping

from mixpose.frames import Source
from mixpose.records import Estimate, Status

_NOTHING = 0.01  # of a sensor's density: below it a sensor takes no part


def warn(message: str) -> None:
    """Say something that does not stop the work but should be looked at."""
    print(f"mixpose: warning: {' '.join(message.split())}", file=sys.stderr)


def warn_of_sources(sources: Mapping[str, Source]) -> None:
    """Say what is odd about the recordings."""
    for name, source in sources.items():
        caution = source.caution()
        if caution:
            warn(f"sensor {name!r}: {caution}")


class Summary:
    """Counts frames as they pass, and says in the end what became of them."""

    def __init__(self) -> None:
        self.statuses: Counter[Status] = Counter()
        self.posed: Counter[str] = Counter()
        self.idle: Counter[str] = Counter()

    def add(self, estimate: Estimate) -> None:
        """Count a frame."""
        self.statuses[estimate.status] += 1
        if estimate.status == "lost":
            return
        for name, report in estimate.sensors.items():
            if report.used:
                self.posed[name] += 1
                self.idle[name] += (report.explained or 0.0) < _NOTHING

    def text(self) -> str:
        """One line: how many frames came to which status."""
        count = sum(self.statuses.values())
        words: tuple[Status, ...] = ("ok", "ambiguous", "lost")
        parts = [f"{self.statuses[word]} {word}" for word in words if self.statuses[word]]
        return f"{count} frame{'s' * (count != 1)}: {', '.join(parts)}"

    def say(self, where: str) -> None:
        """Print the line, and warn of sensors that took no part."""
        if not sum(self.statuses.values()):
            warn("no frame was estimated: the recording has none with the numbers asked for")
            return
        for name, count in self.idle.items():
            if count and count >= 0.8 * self.posed[name]:
                warn(
                    f"sensor {name!r} explained less than 1 % in {count} of {self.posed[name]} "
                    "frames with a pose: check its T_sensor_world, calibration and source"
                )
        if self.statuses["lost"] == sum(self.statuses.values()):
            warn("every frame is lost: try mixpose check, then [start] and [extract]")
        print(f"mixpose: {self.text()}{where}", file=sys.stderr)

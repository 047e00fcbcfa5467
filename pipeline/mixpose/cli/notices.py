"""Remarks to people on standard error, a line each, and the progress of long work."""

from __future__ import annotations

import re
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # whoever only has to say something need not load them
    from mixpose.calibration.task import Progress
    from mixpose.frames import Source
    from mixpose.records import DelayEstimate, Estimate
    from mixpose.session import Session

_NOTHING = 0.01  # of a sensor's density: below it a sensor takes no part
_WELL = 0.1  # above it a sensor is explained, even beside 60 false features
_MOST = 0.8  # of the frames: a sensor that takes no part in so many never does
_OFTEN = 0.2  # of the frames: sensors that take turns do so by no accident
# of sigma: 0.2 is the most in recordings whose geometry is right, 0.8 with a chessboard whose
# squares are given as 25 in place of 24 mm
_FAR_OFF = 0.5
_EARLY = 10  # frames without one that is ok, after which that is said: they may take seconds each
_SURELY_LATE = 6.0  # standard deviations
_LATE_S = 5e-4  # less is rarely worth a key
_REMEMBERED = 10_000  # residuals of a camera: a live source may run for days

_TIMED = 4  # frames by which it is told how long the search takes
_FOUND_BEFORE_S = 2e-3  # what takes less was found by a search that was cut off

# what `frames_text` says, and where poses were written
_FRAMES = re.compile(
    r"mixpose: \d+ frames?(?: of (\d+) bodies)?: (\d+ \w+(?:, \d+ \w+)*)(?: -> |$)"
)


def say(message: str) -> None:
    """Say something on standard error; that nobody can be told stops no work."""
    with suppress(OSError):
        print(f"mixpose: {message}", file=sys.stderr, flush=True)


def warn(message: str) -> None:
    """Say something that does not stop the work but should be looked at."""
    say(f"warning: {' '.join(message.split())}")


def warn_of_sources(
    session: Session, sources: Mapping[str, Source], replaced: Mapping[str, str]
) -> None:
    """Say what is odd about the recordings; `replaced` are those in place of the session's."""
    from mixpose.checking import shared_source_warnings  # noqa: PLC0415 - only a run needs it

    for warning in shared_source_warnings(session, replaced):
        warn(warning)
    for name, source in sources.items():
        if caution := source.caution():
            warn(f"sensor {name!r}: {caution}")


def counted(count: int, what: str) -> str:
    """So many of something, in words."""
    return f"{count} {what}{'s' * (count != 1)}"


def frames_text(statuses: Mapping[str, int], bodies: int) -> str:
    """How many frames there were, and how many poses of theirs came to which status."""
    count = sum(statuses.values()) // bodies
    of = f" of {bodies} bodies" if bodies > 1 else ""
    words = ("ok", "ambiguous", "lost")
    parts = [f"{statuses[word]} {word}" for word in words if statuses.get(word)]
    return f"{counted(count, 'frame')}{of}: {', '.join(parts) or 'none'}"


def told_frames(line: str) -> tuple[dict[str, int], int] | None:
    """The statuses and the number of bodies in a line that a run said in the end; else None."""
    found = _FRAMES.match(line)
    if found is None:
        return None
    bodies, told = found.groups()
    pairs = (part.split(" ", 1) for part in told.split(", "))
    return {status: int(count) for count, status in pairs}, int(bodies or 1)


def origin_of(estimate: Estimate) -> str:
    """A frame's status, which proposer its pose came from, and what a search cost."""
    origin = f", the pose came from: {estimate.proposer}" if estimate.proposer else ""
    if estimate.guesses:
        made, tested, refined = estimate.guesses
        origin += f"; guesses of the search: {made} made, {tested} tested, {refined} refined"
    return estimate.status + origin


class Summary:
    """Counts frames as they pass, and says in the end what became of them."""

    def __init__(self, session: Session) -> None:
        self.sigmas = {
            setup.name: setup.extract.sigma
            for setup in session.sensors
            # ranges err as the place has it, and features of a soft body are off theirs
            if setup.sensor.unit == "px" and not any(one.body.spread for one in session.objects)
        }
        from mixpose.cli.findings import Findings  # noqa: PLC0415 - only a run needs it
        from mixpose.judgement import MEETS_NOTHING  # noqa: PLC0415

        self.idle_for = MEETS_NOTHING
        self.findings, self.path = Findings(session), session.path
        self.bodies = len(session.labels)
        self.counted = "frames with a pose" if self.bodies == 1 else "poses"
        self.statuses: Counter[str] = Counter()
        self.posed: Counter[str] = Counter()
        self.idle: Counter[str] = Counter()
        self.shared = 0  # frames with a pose in which two sensors or more had features
        self.split: Counter[str] = Counter()  # sensors not explained where another one is
        self.split_frames = 0
        self.left_out: Counter[tuple[str, str]] = Counter()  # sensors, and why
        self.residuals = {name: deque[float](maxlen=_REMEMBERED) for name in self.sigmas}
        self.told = {setup.name: setup.delay for setup in session.sensors}
        self.delays: Mapping[str, DelayEstimate] = {}

    def add(self, estimate: Estimate) -> None:
        """Count a frame."""
        self.findings.add(estimate)
        self.statuses[estimate.status] += 1
        self.delays = estimate.delays or self.delays
        count = sum(self.statuses.values())
        if count == _EARLY * self.bodies and not self.statuses["ok"]:
            warn(
                f"no pose in the first {_EARLY} frames is ok, {self.statuses['lost']} of {count} "
                f"are lost; the run goes on, mixpose check {self.path} says what is odd"
            )
        if estimate.status == "lost":
            return
        reasons = {n: one.why for n, one in estimate.sensors.items() if one.why}
        self.left_out.update((n, why) for n, why in reasons.items() if why != self.idle_for)
        shares = {
            n: one.explained or 0.0
            for n, one in estimate.sensors.items()
            if one.used or one.why == self.idle_for
        }
        idle = [name for name, share in shares.items() if share < _NOTHING]
        self.posed.update(shares.keys())
        self.idle.update(idle)
        self.shared += len(shares) > 1
        if idle and max(shares.values()) > _WELL:
            self.split_frames += 1
            self.split.update(idle)
        if estimate.status == "ok":
            found = estimate.weighted_rms
            for name, residuals in self.residuals.items():
                if (rms := found[name]) is not None:
                    residuals.append(rms)

    def say(self, where: str) -> None:
        """Print the line, and warn of sensors that took no part or fit badly."""
        if not sum(self.statuses.values()):
            warn(
                "no frame was estimated: the recording has none, or none with the numbers asked for"
            )
            return
        for warning in self.warnings():
            warn(warning)
        for remark in self.late():
            say(remark)
        if self.statuses["lost"] == sum(self.statuses.values()) and not self.findings.change:
            warn(f"every frame is lost: run mixpose check {self.path}, which says what is odd")
        say(f"{frames_text(self.statuses, self.bodies)}{where}")

    def warnings(self) -> list[str]:
        """What is most likely wrong with the geometry, once for each sensor at most."""
        apart = [n for n, k in self.idle.items() if k >= _MOST * self.posed[n]]
        found = [
            f"sensor {name!r} explained less than 1 % in {self.idle[name]} of {self.posed[name]} "
            f"{self.counted}: check its T_sensor_world, calibration and source, which "
            "mixpose check tries"
            for name in apart
        ]
        posed = sum(self.statuses.values()) - self.statuses["lost"]
        seen, causes = self.findings.of_sensors(), self.findings.causes()
        if not found and self.split_frames and self.split_frames >= _OFTEN * self.shared:
            apart = list(self.split)
            found += [] if seen else [self._split_text()]
        # what names the cause stands for what only shows it
        found = [*([] if self.findings.tells_of_sensors(causes) else found), *seen, *causes]
        found += [
            f"sensor {name!r} was left out of {count} of {posed} {self.counted}: {why}"
            for (name, why), count in self.left_out.items()
        ]
        offs = {n: median(each) for n, each in self.residuals.items() if each and n not in apart}
        far = [
            f"by {off:.2g} px in {name!r} (median; sigma is {self.sigmas[name]:g})"
            for name, off in offs.items()
            if off > _FAR_OFF * self.sigmas[name]
        ]
        if far:
            found.append(
                f"features are met far off, {' and '.join(far)}: is the size of [object], its "
                "unit, the calibration or T_sensor_world wrong, are frames out of step, or are "
                "features found no better?"
            )
        return found

    def late(self) -> list[str]:
        """Which sensors are late by how much, as far as a moving body shows it."""
        remarks = []
        for name, seen in self.delays.items():
            spread = f"(give or take {2 * seen.deviation:.4f})"
            told = self.told.get(name, 0.0)
            if told == "estimate":
                late = f"{seen.seconds:.4f} s {spread}"
                remarks.append(f"sensor {name!r}: delay estimated as {late}")
            elif abs(seen.seconds) > max(_SURELY_LATE * seen.deviation, _LATE_S):
                kind = "late" if seen.seconds > 0 else "early"
                whole = round(told + seen.seconds, 4) + 0.0  # no minus zero
                remarks.append(
                    f"sensor {name!r} is {kind} by {abs(seen.seconds):.4f} s {spread}: "
                    f"delay = {whole:.4f} in its [[sensor]] takes it off"
                )
        return remarks

    def _split_text(self) -> str:
        frames = f"in {self.split_frames} of {self.shared} {self.counted}"
        check = (
            "check the size of [object], its unit, T_sensor_world and calibration, if the body was "
            "in view of all"
        )
        if len(self.posed) == 2:
            return f"{frames} only one of 2 sensors is explained: {check}"
        each = ", ".join(f"{name!r} in {count}" for name, count in self.split.items())
        return f"{frames} not all of {len(self.posed)} sensors are explained ({each} not): {check}"


@contextmanager
def _display(*, shown: bool = True, spins: bool = False) -> Iterator[Any]:
    """A display of rich on standard error, while a person is watching; else None."""
    if not shown or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console  # noqa: PLC0415 - only where it is shown
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    spinning = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    columns = spinning if spins else ()
    with Progress(*columns, console=Console(stderr=True), transient=True) as display:
        yield display


@contextmanager
def bar(
    what: str, total: int | None, *, shown: bool = True, spins: bool = False
) -> Iterator[Callable[..., None]]:
    """What moves a bar on standard error on, while a person is watching; else nothing is seen.

    Of a bar that `spins` nobody is to see how much is left.
    """
    with _display(shown=shown, spins=spins) as display:
        if display is None:
            yield lambda **moved: None
        else:
            yield partial(display.update, display.add_task(what, total=total))


@contextmanager
def watched() -> Iterator[Progress]:
    """Progress: a bar on a terminal; and how long the search will take, before it does."""
    last: dict[str, float] = {}
    took: dict[str, list[float]] = {}

    def expect(stage: str, done: int, total: int) -> None:
        if not stage.startswith("searching") or total <= 20:
            return
        now = time.perf_counter()
        step, last[stage] = now - last.get(stage, now), now
        steps = took.setdefault(stage, [])
        if step < _FOUND_BEFORE_S or len(steps) == _TIMED:
            return
        steps.append(step)
        if len(steps) == _TIMED:
            left, each = total - done, sum(steps) / _TIMED
            seconds = each * left
            about = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
            say(f"{left} frames of cameras left to search, about {about}")

    with _display() as display:
        tasks: dict[str, object] = {}

        def show(stage: str, done: int, total: int) -> None:
            expect(stage, done, total)
            if stage not in tasks:
                for other in tasks.values():
                    display.update(other, visible=False)
                tasks[stage] = display.add_task(stage, total=total)
            display.update(tasks[stage], completed=done, total=total)

        yield expect if display is None else show

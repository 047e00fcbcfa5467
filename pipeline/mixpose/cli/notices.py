"""Messages on standard error, a line each, and the progress of long work."""

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

if TYPE_CHECKING:  # not needed to print a message
    from mixpose.calibration.task import Progress
    from mixpose.records import Estimate
    from mixpose.session import Session

_NOTHING = 0.01  # share of a sensor's density that is explained: below it the sensor is idle
_WELL = 0.1  # share above which a sensor is explained, even with 60 false features
_MOST = 0.8  # share of the frames in which a sensor is idle that never takes part
_OFTEN = 0.2  # share of the frames above which sensors are idle by turns for a reason
# of sigma: at most 0.2 in recordings whose geometry is right, 0.8 with a chessboard whose squares
# are given as 25 in place of 24 mm
_FAR_OFF = 0.5
_EARLY = 10  # first frames: a warning if none of them is ok, as frames may take seconds each
_REMEMBERED = 10_000  # residuals kept of a camera: a live source may run for days

_TIMED = 4  # frames whose times predict the duration of a search
_FOUND_BEFORE_S = 2e-3  # frames that take less time were searched before an interruption

# the line of `frames_text`, and the files of poses after it
_FRAMES = re.compile(
    r"mixpose: \d+ frames?(?: of (\d+) bodies)?: (\d+ \w+(?:, \d+ \w+)*)(?: -> |$)"
)


def say(message: str) -> None:
    """Print a message on standard error; a closed stream stops no work."""
    with suppress(OSError):
        print(f"mixpose: {message}", file=sys.stderr, flush=True)


def warn(message: str) -> None:
    """Print a warning on one line."""
    say(f"warning: {' '.join(message.split())}")


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless the count is 1."""
    return f"{count} {noun}{'s' * (count != 1)}"


def frames_text(statuses: Mapping[str, int], bodies: int) -> str:
    """Return the number of frames and of poses of each status, in words."""
    count = sum(statuses.values()) // bodies
    of = f" of {bodies} bodies" if bodies > 1 else ""
    words = ("ok", "ambiguous", "lost")
    parts = [f"{statuses[word]} {word}" for word in words if statuses.get(word)]
    return f"{counted(count, 'frame')}{of}: {', '.join(parts) or 'none'}"


def parsed_frames(line: str) -> tuple[dict[str, int], int] | None:
    """Parse the last line of a run: counts by status, number of bodies; None for other lines."""
    match = _FRAMES.match(line)
    if match is None:
        return None
    bodies, counts = match.groups()
    pairs = (part.split(" ", 1) for part in counts.split(", "))
    return {status: int(count) for count, status in pairs}, int(bodies or 1)


def origin_of(estimate: Estimate) -> str:
    """Return a frame's status, the proposer of its pose, and the guesses of its search."""
    origin = f", the pose came from: {estimate.proposer}" if estimate.proposer else ""
    if estimate.guesses:
        made, tested, refined = estimate.guesses
        origin += f"; guesses of the search: {made} made, {tested} tested, {refined} refined"
    return estimate.status + origin


class Summary:
    """Count the frames of a run by what became of them; print a summary at the end."""

    def __init__(self, session: Session) -> None:
        is_soft = any(setup.body.spread for setup in session.objects)
        self.sigmas = {
            setup.name: setup.extract.sigma
            for setup in session.sensors
            # errors of ranges depend on the place, and features of a soft body are displaced
            if setup.sensor.unit == "px" and not is_soft
        }
        from mixpose.cli.findings import Findings  # noqa: PLC0415 - only a run needs it
        from mixpose.judgement import MEETS_NOTHING  # noqa: PLC0415

        self.idle_for = MEETS_NOTHING
        self.findings, self.path = Findings(session), session.path
        self.bodies = len(session.labels)
        self.noun = "frames with a pose" if self.bodies == 1 else "poses"
        self.statuses = self.findings.statuses
        self.posed: Counter[str] = Counter()
        self.idle: Counter[str] = Counter()
        self.shared = 0  # frames with a pose in which two sensors or more had features
        self.split: Counter[str] = Counter()  # sensors not explained in frames where another is
        self.split_frames = 0
        self.left_out: Counter[tuple[str, str]] = Counter()  # sensors with reasons
        self.residuals = {name: deque[float](maxlen=_REMEMBERED) for name in self.sigmas}

    def add(self, estimate: Estimate) -> None:
        """Count a frame."""
        self.findings.add(estimate)
        count = sum(self.statuses.values())
        if count == _EARLY * self.bodies and not self.statuses["ok"]:
            warn(
                f"no pose in the first {_EARLY} frames is ok, {self.statuses['lost']} of {count} "
                f"are lost; the run goes on, mixpose check {self.path} says what is odd"
            )
        if estimate.status == "lost":
            return
        reasons = {n: report.why for n, report in estimate.sensors.items() if report.why}
        self.left_out.update((n, why) for n, why in reasons.items() if why != self.idle_for)
        shares = {
            n: report.explained or 0.0
            for n, report in estimate.sensors.items()
            if report.used or report.why == self.idle_for
        }
        idle = [name for name, share in shares.items() if share < _NOTHING]
        self.posed.update(shares.keys())
        self.idle.update(idle)
        self.shared += len(shares) > 1
        if idle and max(shares.values()) > _WELL:
            self.split_frames += 1
            self.split.update(idle)
        if estimate.status == "ok":
            rms_by_sensor = estimate.weighted_rms
            for name, residuals in self.residuals.items():
                if (rms := rms_by_sensor[name]) is not None:
                    residuals.append(rms)

    def say(self, destination: str) -> None:
        """Print warnings, remarks on delays and the number of frames by status."""
        if not sum(self.statuses.values()):
            warn(
                "no frame was estimated: the recording has none, or none with the numbers asked for"
            )
            return
        for warning in self.warnings():
            warn(warning)
        for remark in self.delay_remarks():
            say(remark)
        if self.statuses["lost"] == sum(self.statuses.values()) and not self.findings.change:
            warn(f"every frame is lost: run mixpose check {self.path}, which says what is odd")
        say(f"{frames_text(self.statuses, self.bodies)}{destination}")

    def warnings(self) -> list[str]:
        """Return warnings about sensors, the session and the bodies."""
        idle = [n for n, k in self.idle.items() if k >= _MOST * self.posed[n]]
        warnings = [
            f"sensor {name!r} explained less than 1 % in {self.idle[name]} of {self.posed[name]} "
            f"{self.noun}: check its T_sensor_world, calibration and source, which "
            "mixpose check tries"
            for name in idle
        ]
        posed = sum(self.statuses.values()) - self.statuses["lost"]
        seen, causes = self.findings.sensor_lines(), self.findings.causes()
        if not warnings and self.split_frames and self.split_frames >= _OFTEN * self.shared:
            idle = list(self.split)
            warnings += [] if seen else [self._split_text()]
        # a cause replaces the warnings that are its symptoms
        warnings = [*([] if self.findings.explain_idle(causes) else warnings), *seen, *causes]
        warnings += [
            f"sensor {name!r} was left out of {count} of {posed} {self.noun}: {why}"
            for (name, why), count in self.left_out.items()
        ]
        offs = {n: median(rms) for n, rms in self.residuals.items() if rms and n not in idle}
        far = [
            f"by {off:.2g} px in {name!r} (median; sigma is {self.sigmas[name]:g})"
            for name, off in offs.items()
            if off > _FAR_OFF * self.sigmas[name]
        ]
        if far and not self.findings.late:
            warnings.append(
                f"features are met far off, {' and '.join(far)}: is the size of [object], its "
                "unit, the calibration or T_sensor_world wrong, are frames out of step, or are "
                "features found no better?"
            )
        return warnings

    def delay_remarks(self) -> list[str]:
        """Return remarks about delays of sensors that a moving body has shown."""
        remarks, late = [], self.findings.late
        for name, delay in self.findings.delays.items():
            spread = f"(give or take {2 * delay.deviation:.4f})"
            if self.findings.stated_delays.get(name) == "estimate":
                estimated = f"{delay.seconds:.4f} s {spread}"
                remarks.append(f"sensor {name!r}: delay estimated as {estimated}")
            elif name in late:
                kind = "late" if delay.seconds > 0 else "early"
                whole = round(late[name] + delay.seconds, 4) + 0.0  # no minus zero
                remarks.append(
                    f"sensor {name!r} is {kind} by {abs(delay.seconds):.4f} s {spread}: "
                    f"delay = {whole:.4f} in its [[sensor]] takes it off"
                )
        return remarks

    def _split_text(self) -> str:
        frames = f"in {self.split_frames} of {self.shared} {self.noun}"
        check = (
            "check the size of [object], its unit, T_sensor_world and calibration, if the body was "
            "in view of all"
        )
        if len(self.posed) == 2:
            return f"{frames} only one of 2 sensors is explained: {check}"
        idle = ", ".join(f"{name!r} in {count}" for name, count in self.split.items())
        return f"{frames} not all of {len(self.posed)} sensors are explained ({idle} not): {check}"


@contextmanager
def _display(*, shown: bool = True, spins: bool = False) -> Iterator[Any]:
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
    title: str, total: int | None, *, shown: bool = True, spins: bool = False
) -> Iterator[Callable[..., None]]:
    """Yield a function that advances a progress bar, or a spinner, which only a terminal shows."""
    with _display(shown=shown, spins=spins) as display:
        if display is None:
            yield lambda **changes: None
        else:
            yield partial(display.update, display.add_task(title, total=total))


@contextmanager
def shown_progress() -> Iterator[Progress]:
    """Yield a function that shows progress on a terminal and predicts the duration of a search."""
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
            remaining = total - done
            seconds = sum(steps) / _TIMED * remaining
            about = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
            say(f"{remaining} frames of cameras left to search, about {about}")

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

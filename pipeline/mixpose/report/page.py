"""Render the page of a run: contents, templates, and the session of its poses."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mixpose.errors import SessionError
from mixpose.poses.evaluate import Evaluation, as_numbered, evaluate
from mixpose.poses.jsonl import PoseFile
from mixpose.records import Floats, Status
from mixpose.report.series import Series, errors_of, frame_ranges, series_of
from mixpose.session import Session, load_session

if TYPE_CHECKING:
    from jinja2 import Environment

MARK = '<meta name="generator" content="mixpose report'
"""Mark of pages that mixpose wrote."""

_TEMPLATE, _BODY_TEMPLATE = "page.html.j2", "body.html.j2"
_STATUSES: tuple[Status, ...] = ("ok", "ambiguous", "lost")
_MOST_RANGES = 40
_LARGEST = 2_000_000  # bytes; session files are far smaller


@dataclass(frozen=True)
class Figure:
    """A number that summarises a run."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class SensorRow:
    """Contribution of one sensor to the run."""

    name: str
    model: str
    used: int
    explained: str
    rms: str
    unit: str


def page_templates() -> Environment:
    """Load the templates of pages; raise a `SessionError` that names the missing extra."""
    try:
        import matplotlib  # noqa: F401, PLC0415
        from jinja2 import Environment, FileSystemLoader, StrictUndefined  # noqa: PLC0415
    except ImportError as error:
        raise SessionError(
            f"report: found no {error.name}, which makes the page; install it with the extra "
            "'report': python -m pip install 'mixpose[report]'"
        ) from error
    return Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(poses: PoseFile, truth: PoseFile | None, *, cut: bool, version: str) -> str:
    """Render the report of a run as one self-contained HTML page.

    `cut` says whether the last line of the poses was cut off; `version` is of mixpose. Raises a
    `SessionError` if a library is missing, a `RecordingError` if poses and truth are incomparable.
    """
    environment = page_templates()
    labels = list(dict.fromkeys(line.label for line in poses.poses))
    origin, swaps, named = find_session(poses), None, poses.header.get("session")
    path = Path(named) if isinstance(named, str) and named else poses.path
    if truth is not None and len(labels) > 1:
        poses, swaps = as_numbered(poses, truth)
    files = [_of_body(poses, label) for label in labels] if len(labels) > 1 else [poses]
    template = environment.get_template(_BODY_TEMPLATE)  # of the part on one body
    parts, contents = [], [_body_content(file, truth, cut, origin) for file in files]
    for k, content in enumerate(contents):
        at = f"-{k + 1}" if len(files) > 1 else ""
        parts.append(template.render(at=at, truth=truth, **content))
    counts = [[count for _, count in content["counts"]] for content in contents]
    return environment.get_template(_TEMPLATE).render(
        mark=MARK,
        version=version,
        name="/".join(path.parts[-2:]),  # the folder identifies a run better than the file alone
        truth=truth,
        facts=_facts(poses, labels),
        notices=contents[0]["notices"] if len(files) == 1 else [],
        counts=list(zip(_STATUSES, map(sum, zip(*counts, strict=True)), strict=True)),
        swaps=swaps,
        parts=parts,
        origin=origin,
    )


def _body_content(
    poses: PoseFile, truth: PoseFile | None, cut: bool, origin: Origin
) -> dict[str, Any]:
    """Collect the contents of the page on one body."""
    from mixpose.report import figures  # noqa: PLC0415 - needs matplotlib
    from mixpose.report.overlays import overlay_frames  # noqa: PLC0415

    series = series_of(poses)
    errors = None if truth is None else errors_of(series, poses, truth)
    evaluation = None
    if truth is not None:  # it may contain other bodies
        body_truth = _of_body(truth, series.label)
        evaluation = evaluate(poses, body_truth if body_truth.poses else truth, numbered=True)
    if origin.session is not None and len(origin.session.labels) > 1:
        names = [setup.body.name for setup in origin.session.objects]
        alone = origin.session.with_only(series.object) if series.object in names else None
        origin = replace(origin, session=alone)
    overlays, overlay_notices = overlay_frames(origin.session, poses, series, errors)
    unit_of = _unit_of(origin, series)
    has_poses = bool(np.any(series.status != "lost"))
    return {
        "series": series,
        "notices": list(_notices(poses, series, cut)),
        "counts": [(status, int(np.sum(series.status == status))) for status in _STATUSES],
        "ranges": [(status, _ranges_text(series, status)) for status in _STATUSES[1:]],
        "numbers": list(_numbers(series, evaluation)),
        "evaluation": evaluation,
        "sensor_rows": _sensor_rows(poses, series, origin, unit_of),
        "error_charts": [] if errors is None else figures.errors_over_time(series, errors),
        "trajectory_charts": figures.trajectory(series, errors) if has_poses else [],
        "motion_charts": figures.motion(series, errors) if has_poses else [],
        "sensor_charts": figures.sensors(series, unit_of) + figures.features(series, unit_of)
        if has_poses
        else [],
        "latency_charts": figures.latency(series),
        "overlays": overlays,
        "overlay_notices": overlay_notices,
    }


def _of_body(file: PoseFile, label: str) -> PoseFile:
    return replace(file, poses=tuple(line for line in file.poses if line.label == label))


def _facts(poses: PoseFile, labels: Sequence[str]) -> list[tuple[str, str]]:
    header = poses.header
    facts = {
        "Poses": poses.path,
        "Session": header.get("session"),
        "Objects" if len(labels) > 1 else "Object": ", ".join(labels) or None,
        "Unit": poses.unit,
        "mixpose": header.get("mixpose"),
        "Seed": header.get("seed"),
    }
    return [(name, str(value)) for name, value in facts.items() if value is not None]


def _notices(poses: PoseFile, series: Series, cut: bool) -> Iterator[str]:
    if cut:
        yield (
            "The last line of the poses file is cut off: the run is not finished, or was "
            "interrupted. This report is about the frames before it."
        )
    if not poses.header:
        yield "The poses file has no header, so unit, session and symmetries are not known."
    elif poses.unit is None:
        yield "The header of the poses file states no unit of length."
    if not series.frames:
        yield "The poses file holds no frame."
    elif np.all(series.status == "lost"):
        yield "Every frame is lost, so there is no pose to draw."


def _ranges_text(series: Series, status: Status) -> str:
    ranges = frame_ranges(series, status)
    words = [str(first) if first == last else f"{first}–{last}" for first, last in ranges]
    more = len(words) - _MOST_RANGES
    return ", ".join(words[:_MOST_RANGES]) + (f" and {more} more stretches" if more > 0 else "")


def _numbers(series: Series, evaluation: Evaluation | None) -> Iterator[Figure]:
    yield Figure("frames", str(len(series.frames)), _span(series))
    if evaluation is not None and evaluation.rotation_deg and evaluation.translation:
        for name, errors, unit in (
            ("rotation error, RMS", evaluation.rotation_deg, "°"),
            ("position error, RMS", evaluation.translation, f" {series.unit}"),
        ):
            most = f"at most {_short(errors.max)}{unit}"
            yield Figure(name, f"{_short(errors.rms)}{unit}", most)
    for name, widths, unit in (
        ("position, 95 %", series.half_width[:, :3], f" {series.unit}"),
        ("turn, 95 %", series.half_width[:, 3:], "°"),
    ):
        widest = widths.max(axis=1) if len(widths) else np.empty(0)
        if not np.isnan(widest).all():
            middle, count = float(np.nanmedian(widest)), int(np.isinf(widest).sum())
            value = "open" if np.isinf(middle) else f"± {_short(middle)}{unit}"
            note = f"; open in {count} frames" if count else ""
            yield Figure(name, value, f"median of the least certain axis{note}")
    posed = series.score[[status != "lost" for status in series.status]]
    if np.isfinite(posed).any():
        yield Figure("score", _median(posed), "median of frames with a pose; 1 is best")
    if np.isfinite(series.latency_ms).any():
        slow = float(np.nanpercentile(series.latency_ms, 95))
        value = f"{_median(series.latency_ms)} ms"
        yield Figure("per frame", value, f"median; 95 % within {_short(slow)} ms")


def _span(series: Series) -> str:
    if not series.frames:
        return ""
    first, last = series.frames[0], series.frames[-1]
    span = f"{first} to {last}" if last != first else f"{first}"
    if last != first and series.x_label.startswith("time"):
        span += f", {series.x[-1] - series.x[0]:.4g} s"
    return span


def _sensor_rows(
    poses: PoseFile, series: Series, origin: Origin, unit_of: Callable[[str], str]
) -> list[SensorRow]:
    setups = {} if origin.session is None else {s.name: s for s in origin.session.sensors}
    return [
        SensorRow(
            name=name,
            model=setups[name].model if name in setups else "",
            used=sum(name in line.sensors and line.sensors[name].used for line in poses.poses),
            explained=_median(series.explained[name]),
            rms=_median(series.rms[name]),
            unit=unit_of(name),
        )
        for name in series.rms
    ]


def _unit_of(origin: Origin, series: Series) -> Callable[[str], str]:
    """Return a function from the name of a sensor to the unit of its residuals, if known."""
    setups = () if origin.session is None else origin.session.sensors
    units = {s.name: "px" if s.sensor.unit == "px" else series.unit for s in setups}
    return lambda name: units.get(name, "sensor units")


def _median(values: Floats) -> str:
    known = values[np.isfinite(values)]
    return _short(float(np.median(known))) if known.size else "–"


def _short(value: float) -> str:
    """Format a number with three significant digits, or as an integer from 1000 to a million."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


@dataclass(frozen=True)
class Origin:
    """What is known of the session file of a run."""

    path: Path | None = None  # of the file that was read
    text: str | None = None  # its text
    notice: str | None = None  # problem: missing, changed, no longer a session
    session: Session | None = None  # only if the file is unchanged since the run


def find_session(poses: PoseFile) -> Origin:
    """Read the session file that the header names, or one of the same name next to the poses.

    A file that has changed is shown only if it is a session file: a header may name any file, and
    its contents should not be passed on with the page.
    """
    named = poses.header.get("session")
    if not isinstance(named, str) or not named:
        return Origin(notice="The poses file names no session file.")
    wanted = poses.header.get("session_sha256")
    candidates = [
        (path, content)
        for path in (Path(named), poses.path.parent / Path(named).name)
        if (content := _bytes_of(path)) is not None
    ]
    if not candidates:
        return Origin(notice=f"The session file {named} is missing or cannot be read.")
    for path, content in candidates:
        if hashlib.sha256(content).hexdigest() == wanted:
            text = content.decode("utf-8-sig", errors="replace")
            try:
                return Origin(path, text, session=load_session(path))
            except SessionError as error:
                return Origin(path, text, f"The session cannot be read again: {error}")
    path, content = candidates[0]
    notice = f"The poses file states no SHA-256, so {path} may have changed since the run."
    if isinstance(wanted, str):
        notice = f"{path} has changed since the run: its SHA-256 is not the one in the poses file."
    try:
        load_session(path)
    except SessionError:
        return Origin(path, notice=f"{notice} It is no session file now and is not shown.")
    return Origin(path, content.decode("utf-8-sig", errors="replace"), notice)


def _bytes_of(path: Path) -> bytes | None:
    """Read a file; None if it is missing, unreadable or too large for a session."""
    with suppress(OSError):
        if path.is_file() and path.stat().st_size <= _LARGEST:
            return path.read_bytes()
    return None

"""The page: what it says, put into its template, and the session that its poses came from."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
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
"""By which a page is known as one of ours."""

_TEMPLATE, _BODY_TEMPLATE = "page.html.j2", "body.html.j2"
_STATUSES: tuple[Status, ...] = ("ok", "ambiguous", "lost")
_MOST_RANGES = 40
_LARGEST = 2_000_000  # bytes; no session file is near it


@dataclass(frozen=True)
class Figure:
    """A number that sums a run up."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class SensorRow:
    """How one sensor took part in the run."""

    name: str
    model: str
    used: int
    explained: str
    rms: str
    unit: str


def page_templates() -> Environment:
    """The templates of pages, or a `SessionError` that names the extra with what makes them."""
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
    """The report of a run as one HTML page without anything outside it.

    `cut` says whether the last line of the poses was cut off; `version` is of mixpose. A
    `SessionError` if a library is missing, a `RecordingError` if poses and truth cannot be
    compared.
    """
    environment = page_templates()
    labels = list(dict.fromkeys(line.label for line in poses.poses))
    origin, swaps, named = find_session(poses), None, poses.header.get("session")
    path = Path(named) if isinstance(named, str) and named else poses.path
    if truth is not None and len(labels) > 1:
        poses, swaps = as_numbered(poses, truth)
    files = [_of_body(poses, label) for label in labels] if len(labels) > 1 else [poses]
    template = environment.get_template(_BODY_TEMPLATE)  # of what is said of each body
    parts, contents = [], [_body_content(each, truth, cut, origin) for each in files]
    for k, content in enumerate(contents):
        at = f"-{k + 1}" if len(files) > 1 else ""
        parts.append(template.render(at=at, truth=truth, **content))
    counts = [[count for _, count in content["counts"]] for content in contents]
    return environment.get_template(_TEMPLATE).render(
        mark=MARK,
        version=version,
        name="/".join(path.parts[-2:]),  # the folder says more than the file alone
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
    """What the page says about one body."""
    from mixpose.report import figures  # noqa: PLC0415 - needs matplotlib
    from mixpose.report.overlays import overlay_frames  # noqa: PLC0415

    series = series_of(poses)
    errors = None if truth is None else errors_of(series, poses, truth)
    evaluation = None
    if truth is not None:  # which may hold other bodies
        own = _of_body(truth, series.label)
        evaluation = evaluate(poses, own if own.poses else truth, numbered=True)
    if origin.session is not None and len(origin.session.labels) > 1:
        names = [one.body.name for one in origin.session.objects]
        alone = origin.session.with_only(series.object) if series.object in names else None
        origin = replace(origin, session=alone)
    overlays, overlay_notices = overlay_frames(origin.session, poses, series, errors)
    unit_of = _unit_of(origin, series)
    has_poses = bool(np.any(series.status != "lost"))
    return {
        "series": series,
        "notices": _notices(poses, series, cut),
        "counts": [(status, int(np.sum(series.status == status))) for status in _STATUSES],
        "ranges": [(status, _ranges_text(series, status)) for status in _STATUSES[1:]],
        "numbers": _numbers(series, evaluation),
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


def _notices(poses: PoseFile, series: Series, cut: bool) -> list[str]:
    notices = []
    if cut:
        notices.append(
            "The last line of the poses file is cut off: the run is not finished, or was "
            "interrupted. This report is about the frames before it."
        )
    if not poses.header:
        notices.append(
            "The poses file has no header, so unit, session and symmetries are not known."
        )
    elif poses.unit is None:
        notices.append("The header of the poses file states no unit of length.")
    if not series.frames:
        notices.append("The poses file holds no frame.")
    elif np.all(series.status == "lost"):
        notices.append("Every frame is lost, so there is no pose to draw.")
    return notices


def _ranges_text(series: Series, status: Status) -> str:
    ranges = frame_ranges(series, status)
    words = [str(first) if first == last else f"{first}–{last}" for first, last in ranges]
    more = len(words) - _MOST_RANGES
    return ", ".join(words[:_MOST_RANGES]) + (f" and {more} more stretches" if more > 0 else "")


def _numbers(series: Series, evaluation: Evaluation | None) -> list[Figure]:
    found = [Figure("frames", str(len(series.frames)), _span(series))]
    if evaluation is not None and evaluation.rotation_deg and evaluation.translation:
        for name, errors, unit in (
            ("rotation error, RMS", evaluation.rotation_deg, "°"),
            ("position error, RMS", evaluation.translation, f" {series.unit}"),
        ):
            most = f"at most {_short(errors.max)}{unit}"
            found.append(Figure(name, f"{_short(errors.rms)}{unit}", most))
    for name, widths, unit in (
        ("position, 95 %", series.half_width[:, :3], f" {series.unit}"),
        ("turn, 95 %", series.half_width[:, 3:], "°"),
    ):
        widest = widths.max(axis=1) if len(widths) else np.empty(0)
        if not np.isnan(widest).all():
            middle, count = float(np.nanmedian(widest)), int(np.isinf(widest).sum())
            value = "open" if np.isinf(middle) else f"± {_short(middle)}{unit}"
            note = f"; open in {count} frames" if count else ""
            found.append(Figure(name, value, f"median of the least certain axis{note}"))
    posed = series.score[[status != "lost" for status in series.status]]
    if np.isfinite(posed).any():
        found.append(Figure("score", _median(posed), "median of frames with a pose; 1 is best"))
    if np.isfinite(series.latency_ms).any():
        slow = float(np.nanpercentile(series.latency_ms, 95))
        value = f"{_median(series.latency_ms)} ms"
        found.append(Figure("per frame", value, f"median; 95 % within {_short(slow)} ms"))
    return found


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
    """Unit of the residuals of a sensor, as far as the session can tell."""
    setups = () if origin.session is None else origin.session.sensors
    units = {s.name: "px" if s.sensor.unit == "px" else series.unit for s in setups}
    return lambda name: units.get(name, "sensor units")


def _median(values: Floats) -> str:
    known = values[np.isfinite(values)]
    return _short(float(np.median(known))) if known.size else "–"


def _short(value: float) -> str:
    """Three digits that count, and no power of ten where people would write none."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


@dataclass(frozen=True)
class Origin:
    """What is known of the session file."""

    named: str | None = None  # path in the header of the poses
    path: Path | None = None  # where it was found
    text: str | None = None  # its text
    notice: str | None = None  # what is wrong: missing, changed, no session any more
    # only if the file is the very one that the poses were estimated with
    session: Session | None = None


def find_session(poses: PoseFile) -> Origin:
    """Read the session file that the header names, or its like beside the poses.

    A file that is not the one of the run is shown only if it is a session file: a header may name
    any file, and whoever passes the page on should not pass on that.
    """
    named = poses.header.get("session")
    if not isinstance(named, str) or not named:
        return Origin(notice="The poses file names no session file.")
    wanted = poses.header.get("session_sha256")
    found = [
        (path, content)
        for path in (Path(named), poses.path.parent / Path(named).name)
        if (content := _bytes_of(path)) is not None
    ]
    if not found:
        return Origin(named, notice=f"The session file {named} is missing or cannot be read.")
    for path, content in found:
        if hashlib.sha256(content).hexdigest() == wanted:
            text = content.decode("utf-8-sig", errors="replace")
            try:
                return Origin(named, path, text, session=load_session(path))
            except SessionError as error:
                return Origin(named, path, text, f"The session cannot be read again: {error}")
    path, content = found[0]
    notice = f"The poses file states no SHA-256, so {path} may have changed since the run."
    if isinstance(wanted, str):
        notice = f"{path} has changed since the run: its SHA-256 is not the one in the poses file."
    try:
        load_session(path)
    except SessionError:
        return Origin(named, path, notice=f"{notice} It is no session file now and is not shown.")
    return Origin(named, path, content.decode("utf-8-sig", errors="replace"), notice)


def _bytes_of(path: Path) -> bytes | None:
    with suppress(OSError):
        if path.is_file() and path.stat().st_size <= _LARGEST:
            return path.read_bytes()
    return None

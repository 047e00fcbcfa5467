"""Draw the figures of a report as small SVGs in the colours of the page.

Texts stay texts, and ink and rules have the colours of the page, so that a figure follows the
reader's fonts and background.  Titles are not part of the figures: the page escapes names in them.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.report.series import Errors, Series, jumps_of_turns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Legible on white and on near black alike.
_BLUE, _ORANGE, _RED, _GREY = "#2f80d0", "#d9780f", "#dc4450", "#8a8f98"

POSE: dict[str, Any] = {"color": _BLUE}
TRUTH: dict[str, Any] = {"color": _GREY, "linestyle": (0, (3, 1.5)), "linewidth": 1.1, "marker": ""}
BAND: dict[str, Any] = {"color": _BLUE, "linewidth": 0.9, "markersize": 1.5}
_AMBIGUOUS: dict[str, Any] = {"linestyle": "none", "marker": "D", "color": _ORANGE, "zorder": 4}

# Placeholders that `svg_of` replaces by the page's colours.
_INK, _RULE = "#1a1b1c", "#c1c2c3"

_WIDTH = 4.4  # inches; on the page a figure is 1 to 1.5 times as large
_HEIGHT = 2.5
_DOTS = 100  # frames; more of them are lines without dots
_MANY = 250  # frames; more of them are drawn as pixels, lest the page grow
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mixpose",
    "font.size": 9.5,
    "axes.edgecolor": _RULE,
    "axes.labelcolor": _INK,
    "axes.titlecolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.offset_threshold": 6,  # common digits; ticks with as many fit side by side
    "axes.formatter.limits": (-4, 5),
    "grid.color": _RULE,
    "grid.linewidth": 0.4,
    "text.color": _INK,
    "xtick.color": _RULE,
    "ytick.color": _RULE,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
}
AXES = ("x", "y", "z")
_BINS = 40


def blank(height: float = _HEIGHT) -> tuple[Figure, Axes]:
    """Return an empty figure with one pair of axes; `height` in inches."""
    figure, (axes,) = stacked((1.0,), height)
    return figure, axes


def stacked(shares: tuple[float, ...], height: float = 1.15 * _HEIGHT) -> tuple[Figure, list[Axes]]:
    """Return a figure with pairs of axes one above the other that share the time axis."""
    from matplotlib import rc_context  # noqa: PLC0415 - heavy
    from matplotlib.figure import Figure  # noqa: PLC0415

    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH, height), layout="constrained")
        grid = figure.subplots(len(shares), squeeze=False, sharex=True, height_ratios=shares)
    return figure, list(grid[:, 0])


class TimeAxes:
    """Axes over all frames of a run; stretches of lost frames are shaded from top to bottom.

    Lines break at lost or missing frames, and at `jumps` (n,), which are no motion.
    """

    def __init__(self, axes: Axes, series: Series, jumps: Mask | None = None) -> None:
        self._axes, self._series = axes, series
        self._breaks = series.breaks if jumps is None else series.breaks | jumps
        x, gaps = series.x, np.diff(series.x)
        half_step = 0.5 * float(np.median(gaps)) if gaps.any() else 0.5
        # without outlines; as pixels if there are many frames
        self._filled: dict[str, Any] = {"linewidth": 0, "rasterized": len(x) > _MANY}
        edges = np.flatnonzero(np.diff(series.status == "lost", prepend=False, append=False))
        stretches = [
            (x[first] - half_step, x[last - 1] - x[first] + 2 * half_step)
            for first, last in edges.reshape(-1, 2)
        ]
        if stretches:
            full_height = axes.get_xaxis_transform()
            style: dict[str, Any] = {"color": _RED, "alpha": 0.3, **self._filled}
            axes.broken_barh(stretches, (0.0, 1.0), transform=full_height, **style)
        if x.size:
            margin = max(0.01 * float(x[-1] - x[0]), half_step)
            axes.set_xlim(float(x.min()) - margin, float(x.max()) + margin)

    def draw(self, values: Floats, style: dict[str, Any] = POSE) -> None:
        """Draw values (n,) as a line."""
        line(self._axes, self._series.x, values, self._breaks, style)

    def band(self, values: Floats, half_width: Floats) -> None:
        """Fill the band about values (n,)."""
        x, y, width = _broken(np.array([self._series.x, values, half_width]), self._breaks)
        self._axes.fill_between(x, y - width, y + width, color=_BLUE, alpha=0.25, **self._filled)


def line(axes: Axes, x: Floats, y: Floats, breaks: Mask, style: dict[str, Any] = POSE) -> None:
    """Draw a line, interrupted at breaks and missing values, with dots where it would not show."""
    is_raster, has_dots = len(x) > _MANY, len(x) <= _DOTS
    x, y = _broken(x, breaks), _broken(y, breaks)
    style = {"linewidth": 1.3, "marker": "o", "markersize": 2.5, "rasterized": is_raster, **style}
    if not has_dots:
        known = np.isfinite(x + y)
        has_neighbour = np.r_[False, known[:-1]] | np.r_[known[1:], False]
        style["markevery"] = np.flatnonzero(known & ~has_neighbour).tolist()
    axes.plot(x, y, **style)


def mark_ambiguous(axes: Axes, x: Floats, y: Floats, series: Series) -> None:
    """Mark ambiguous frames at places (x, y) of all n frames; marks are smaller for many frames."""
    doubtful = series.status == "ambiguous"
    size = 3.5 * np.clip(np.sqrt(_DOTS / max(len(x), 1)), 0.4, 1.0)
    style = {**_AMBIGUOUS, "markeredgewidth": 0, "markersize": size, "rasterized": len(x) > _MANY}
    axes.plot(x[doubtful], y[doubtful], **style)


def _broken(values: Floats, breaks: Mask) -> Floats:
    """Insert a NaN before each break into values (..., n)."""
    return np.insert(values, np.flatnonzero(breaks), np.nan, axis=-1)


def svg_of(figure: Figure) -> str:
    """Return a figure as an ``<svg>`` element without references outside of it."""
    from matplotlib import rc_context  # noqa: PLC0415

    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context(_STYLE):
        figure.savefig(buffer, format="svg", transparent=True, dpi=200, metadata=no_metadata)
    text = buffer.getvalue()
    width, height = 72 * figure.get_size_inches()
    content = text[text.index(">", text.index("<svg")) + 1 :]
    content = re.sub(r"<style.*?</style>|<!--.*?-->", "", content, flags=re.DOTALL)
    content = re.sub(r'<g id="[^"]*"', "<g", content)
    # the ids of all figures on a page must differ
    prefix = hashlib.sha256(content.encode()).hexdigest()[:12]
    content = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}-", content)
    content = content.replace(_INK, "var(--ink)").replace(_RULE, "var(--rule)")
    return f'<svg viewBox="0 0 {width:g} {height:g}" aria-hidden="true">{content.strip()}'


@dataclass(frozen=True)
class Chart:
    """One figure of the page."""

    title: str  # may contain names that people gave; the page escapes it
    alt: str  # description for those who cannot see the figure
    svg: str  # an ``<svg>`` element


def trajectory(series: Series, errors: Errors | None) -> list[Chart]:
    """Draw the path of the object's origin in three planes of the world."""
    return [_plane(series, errors, a, b) for a, b in ((0, 1), (0, 2), (1, 2))]


def motion(series: Series, errors: Errors | None) -> list[Chart]:
    """Draw position and turn over time with 95 % bands, a chart per axis."""
    truths = (None, None) if errors is None else (errors.position, errors.turn_deg)
    kinds = (
        ("position", series.unit, series.position, truths[0]),
        ("turn about", "deg", series.turn_deg, truths[1]),
    )
    charts = []
    for kind, (word, unit, values, true_values) in enumerate(kinds):
        jumps = np.zeros(len(series.x), dtype=bool)
        for turns in (values, true_values) if kind else ():
            jumps |= False if turns is None else jumps_of_turns(turns)
        for k, axis in enumerate(AXES):
            truth = None if true_values is None else true_values[:, k]
            half_width = series.half_width[:, 3 * kind + k]
            title = f"{word.capitalize()} {axis}, {unit}"
            svg = _curve_with_band(series, values[:, k], half_width, truth, jumps)
            alt = _alt_text(title, values[:, k])
            is_open = np.isinf(half_width)
            alt += f"; {_open_note(is_open, half_width)}" if is_open.any() else ""
            charts.append(Chart(title, alt, svg))
    return charts


_MOST_ROWS = 60  # features of a sensor that are drawn


def sensors(series: Series, unit_of: Callable[[str], str]) -> list[Chart]:
    """Draw residuals and explained shares of sensors over time; `unit_of` gives units by name."""
    charts = []
    for name, rms in series.rms.items():
        explained = series.explained[name]
        unit = unit_of(name)
        figure, (upper, lower) = stacked((1.0, 1.0))
        for axes, values, label in ((upper, rms, f"rms, {unit}"), (lower, explained, "explained")):
            _draw_positive(axes, series, values)
            axes.set_ylabel(label)
        lower.set_ylim(0.0, 1.02)
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(series.x_label)
        alt = f"{_alt_text(f'{name}: rms, {unit}', rms)}; {_alt_text('explained share', explained)}"
        charts.append(Chart(name, alt, svg_of(figure)))
    return charts


def features(series: Series, unit_of: Callable[[str], str]) -> list[Chart]:
    """Draw the residuals of features over time, a chart per sensor, a row per feature."""
    charts = []
    for name, residuals in series.residuals.items():
        if not residuals:
            continue
        rows = np.array(list(residuals.values()))[:_MOST_ROWS]
        met = np.isfinite(rows)
        figure, axes = blank()
        largest = float(np.quantile(rows[met], 0.98)) if met.any() else 1.0
        steps = np.diff(series.x)
        half = 0.5 * (float(np.median(steps)) if steps.size else 1.0)
        # cells are empty where frames are missing
        gaps = np.flatnonzero(series.breaks)
        x = np.insert(series.x - half, gaps, series.x[gaps - 1] + half)
        x = np.append(x, series.x[-1] + half)
        rows = _broken(rows, series.breaks)
        y = np.arange(len(rows) + 1) - 0.5
        shown = np.ma.masked_invalid(np.where(np.isfinite(rows), rows, np.nan))
        mesh = axes.pcolormesh(x, y, shown, vmin=0.0, vmax=largest, cmap="viridis", rasterized=True)
        unmet = np.ma.masked_where(~np.isinf(rows), np.ones_like(rows))
        axes.pcolormesh(x, y, unmet, vmin=0.0, vmax=1.0, cmap="Reds", rasterized=True)
        figure.colorbar(mesh, ax=axes, label=f"off by, {unit_of(name)}")
        axes.set_yticks(range(len(rows)), list(residuals)[: len(rows)], parse_math=False)
        axes.set(xlabel=series.x_label, ylabel="feature; red: not met")
        finite = {feature: values[np.isfinite(values)] for feature, values in residuals.items()}
        worst = max(finite, key=lambda f: np.median(finite[f]) if finite[f].size else 0.0)
        alt = f"{name}: how far off each feature is met over time; the farthest off is {worst}"
        charts.append(Chart(f"{name}: features", alt, svg_of(figure)))
    return charts


def latency(series: Series) -> list[Chart]:
    """Draw a histogram of the latency of frames over a logarithmic axis."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter  # noqa: PLC0415 - heavy

    known = series.latency_ms[series.latency_ms > 0]  # NaN is not greater either
    if not known.size:
        return []
    low, high = float(known.min()), float(known.max())
    low, high = (low / 1.5, high * 1.5) if high < 1.5 * low else (low, high)
    edges = np.geomspace(low, high, min(_BINS, 8 + len(known) // 4) + 1)
    figure, axes = blank()
    axes.hist(known, bins=np.clip(edges, low, high).tolist(), **POSE)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
    axes.set_xscale("log")
    # ticks as people write numbers
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=7))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="latency, ms", ylabel="frames")
    title = "Time per frame"
    return [Chart(title, _alt_text("Time per frame, ms", known), svg_of(figure))]


def errors_over_time(series: Series, errors: Errors) -> list[Chart]:
    """Draw errors of rotation and position over the frames."""
    titles = "Rotation error, deg", f"Position error, {series.unit}"
    charts = []
    for title, values in zip(titles, (errors.rotation_deg, errors.distance), strict=True):
        figure, axes = blank()
        _draw_positive(axes, series, values)
        axes.set_xlabel(series.x_label)
        charts.append(Chart(title, _alt_text(title, values), svg_of(figure)))
    return charts


def _draw_positive(axes: Axes, series: Series, values: Floats) -> None:
    """Draw non-negative values of all frames; mark ambiguous and lost ones."""
    TimeAxes(axes, series).draw(values)
    mark_ambiguous(axes, series.x, values, series)
    axes.set_ylim(bottom=0.0)


def _plane(series: Series, errors: Errors | None, a: int, b: int) -> Chart:
    """Draw the path of the origin, and the true one, over world axes a and b."""
    figure, axes = blank(height=3.6)
    x, y = series.position[:, a], series.position[:, b]
    if errors is not None:
        line(axes, errors.position[:, a], errors.position[:, b], series.breaks, TRUTH)
    line(axes, x, y, series.breaks)
    mark_ambiguous(axes, x, y, series)
    known = np.flatnonzero(series.status != "lost")
    ends = {"linestyle": "none", "zorder": 5, "markersize": 7, "fillstyle": "none", **POSE}
    for k, marker in zip(known[[0, -1]] if len(known) else (), "os"):  # the first and the last
        axes.plot(x[k], y[k], marker=marker, **ends)
    axes.set_aspect("equal", adjustable="datalim")
    axes.ticklabel_format(useOffset=False)
    axes.set(xlabel=f"{AXES[a]}, {series.unit}", ylabel=f"{AXES[b]}, {series.unit}")
    title = f"Plane {AXES[a]}{AXES[b]}"
    ranges = [_alt_text(AXES[k], series.position[:, k]) for k in (a, b)]
    return Chart(title, f"{title}, {series.unit}: {'; '.join(ranges)}", svg_of(figure))


def _curve_with_band(
    series: Series, values: Floats, half_width: Floats, truth: Floats | None, jumps: Mask
) -> str:
    """Draw values with their band above, the half-width below; no band where it is open."""
    figure, (upper, lower) = stacked((3.0, 1.2))
    is_open = np.isinf(half_width)
    half_width = np.where(is_open, np.nan, half_width)
    panel = TimeAxes(upper, series, jumps)
    panel.band(values, half_width)
    if truth is not None:
        panel.draw(truth, TRUTH)
    panel.draw(values)
    mark_ambiguous(upper, series.x, values, series)
    limit(upper, values, truth, half_width)
    upper.tick_params(labelbottom=False)
    TimeAxes(lower, series).draw(half_width, BAND)
    positive = half_width[half_width > 0]
    # one badly determined frame must not flatten all others
    if positive.size and positive.max() > 30 * np.median(positive):
        lower.set_yscale("log")
    else:
        lower.set_ylim(0.0, 1.15 * float(positive.max()) if positive.size else 1.0)
    if is_open.any() and not positive.size:
        lower.set_yticks([])
    if is_open.any():
        lower.set_title(_open_note(is_open, half_width), fontsize="small", loc="left")
    lower.set(xlabel=series.x_label, ylabel="± 95 %")
    return svg_of(figure)


def _open_note(is_open: Mask, half_width: Floats) -> str:
    """Describe the frames whose covariance leaves a direction open."""
    count, known = int(is_open.sum()), int(is_open.sum() + np.isfinite(half_width).sum())
    return f"open in {count} of {known} frames, where any value fits: no band"


def limit(axes: Axes, values: Floats, truth: Floats | None, half_width: Floats) -> None:
    """Set the limits of the ordinate by the values, not by the widest band."""
    shown = values if truth is None else np.concatenate([values, truth])
    shown = shown[np.isfinite(shown)]
    if not shown.size:
        return
    low, high = float(shown.min()), float(shown.max())
    widths = half_width[np.isfinite(half_width)]
    band = 1.2 * float(np.median(widths)) if widths.size else 0.0
    least = 1e-3 * max(abs(low), abs(high)) or 1.0  # a held direction does not move at all
    margin = max(0.06 * (high - low), band, least if high - low < 1e-9 * least else 0.0)
    axes.set_ylim(low - margin, high + margin)


def _alt_text(title: str, values: Floats) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return f"{title}: no values"
    return f"{title}: from {known.min():.4g} to {known.max():.4g}, median {np.median(known):.4g}"

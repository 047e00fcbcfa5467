"""Drawing over time with matplotlib, to SVG that lives inside the page.

Texts stay texts, and the colours of ink and rules are the page's own, so that a figure follows
the reader's fonts and light or dark background.
"""

from __future__ import annotations

import hashlib
import io
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from mixpose.records import Floats
from mixpose.report.series import Flags, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Legible on white and on near black alike.
_BLUE, _ORANGE, _RED, _GREY = "#2f80d0", "#d9780f", "#dc4450", "#8a8f98"

POSE: dict[str, Any] = {"color": _BLUE}
BARS: dict[str, Any] = {"color": _BLUE}
TRUTH: dict[str, Any] = {"color": _GREY, "linestyle": (0, (3, 1.5)), "linewidth": 1.1, "marker": ""}
BAND: dict[str, Any] = {"color": _BLUE, "linewidth": 0.9, "markersize": 1.5}
_AMBIGUOUS: dict[str, Any] = {
    "linestyle": "none",
    "marker": "D",
    "markeredgewidth": 0,
    "color": _ORANGE,
    "zorder": 4,
}

# Stand-ins that `drawn` exchanges for the page's colours.
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
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "grid.color": _RULE,
    "grid.linewidth": 0.4,
    "text.color": _INK,
    "xtick.color": _RULE,
    "ytick.color": _RULE,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
}


def blank(height: float = _HEIGHT) -> tuple[Figure, Axes]:
    """An empty figure with one pair of axes; `height` in inches."""
    figure, axes = _figure(height, (1.0,))
    return figure, axes[0]


def stacked(shares: tuple[float, float]) -> tuple[Figure, tuple[Axes, Axes]]:
    """A figure with two pairs of axes, one above the other, with a common time axis."""
    figure, axes = _figure(_HEIGHT * 1.15, shares)
    return figure, (axes[0], axes[1])


def _figure(height: float, shares: tuple[float, ...]) -> tuple[Figure, list[Axes]]:
    from matplotlib import rc_context  # noqa: PLC0415 - heavy
    from matplotlib.figure import Figure  # noqa: PLC0415

    with rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH, height), layout="constrained")
        grid = figure.subplots(
            len(shares), 1, squeeze=False, sharex=True, height_ratios=list(shares)
        )
    return figure, list(grid[:, 0])


class TimeAxes:
    """Axes over the frames of a run; lines break at `jumps` (n,), which are no motion."""

    def __init__(self, axes: Axes, series: Series, jumps: Flags | None = None) -> None:
        self._axes, self._series = axes, series
        self._breaks = series.breaks if jumps is None else series.breaks | jumps
        self._as_pixels = len(series.x) > _MANY
        gaps = np.diff(series.x)
        self._half_step = 0.5 * float(np.median(gaps)) if gaps.size else 0.5

    def frame(self) -> None:
        """Show all frames, those without a value too."""
        x = self._series.x
        if x.size:
            margin = max(0.01 * float(x[-1] - x[0]), self._half_step)
            self._axes.set_xlim(float(x.min()) - margin, float(x.max()) + margin)

    def draw(self, values: Floats, look: dict[str, Any] = POSE) -> None:
        """Draw a line that breaks where frames are lost or left out."""
        line(self._axes, self._series.x, values, self._breaks, look)

    def band(self, values: Floats, half_width: Floats) -> None:
        """Fill the band about values."""
        x, y, width = (_broken(each, self._breaks) for each in (self._series.x, values, half_width))
        self._axes.fill_between(
            x,
            y - width,
            y + width,
            color=_BLUE,
            alpha=0.25,
            linewidth=0,
            rasterized=self._as_pixels,
        )

    def mark_ambiguous(self, values: Floats) -> None:
        """Mark the values of ambiguous frames."""
        mark_ambiguous(self._axes, self._series.x, values, self._series)

    def mark_lost(self) -> None:
        """Shade the stretches of lost frames from top to bottom."""
        lost = self._series.status == "lost"
        edges = np.flatnonzero(np.diff(lost, prepend=False, append=False))
        x = self._series.x
        stretches = [
            (x[first] - self._half_step, x[last - 1] - x[first] + 2 * self._half_step)
            for first, last in edges.reshape(-1, 2)
        ]
        if stretches:
            self._axes.broken_barh(
                stretches,
                (0.0, 1.0),
                transform=self._axes.get_xaxis_transform(),
                color=_RED,
                alpha=0.3,
                linewidth=0,
                rasterized=self._as_pixels,
            )


def line(axes: Axes, x: Floats, y: Floats, breaks: Flags, look: dict[str, Any] = POSE) -> None:
    """Draw a line that leaves out breaks and missing values, and dots where it would not show."""
    many, dotted = len(x) > _MANY, len(x) <= _DOTS
    x, y = _broken(x, breaks), _broken(y, breaks)
    look = {"linewidth": 1.3, "marker": "o", "markersize": 2.5, "rasterized": many, **look}
    if not dotted:
        known = np.isfinite(x + y)
        beside = np.r_[False, known[:-1]] | np.r_[known[1:], False]
        look["markevery"] = np.flatnonzero(known & ~beside).tolist()
    axes.plot(x, y, **look)


def mark_ambiguous(axes: Axes, x: Floats, y: Floats, series: Series) -> None:
    """Mark ambiguous frames at places (x, y) of all n frames; smaller where they are many."""
    doubtful = series.status == "ambiguous"
    size = 3.5 * np.clip(np.sqrt(_DOTS / max(len(x), 1)), 0.4, 1.0)
    look = {**_AMBIGUOUS, "markersize": size, "rasterized": len(x) > _MANY}
    axes.plot(x[doubtful], y[doubtful], **look)


def _broken(values: Floats, breaks: Flags) -> Floats:
    """Values with a NaN before each break."""
    return np.insert(values, np.flatnonzero(breaks), np.nan)


def drawn(figure: Figure) -> str:
    """An ``<svg>`` element that names nothing outside itself."""
    from matplotlib import rc_context  # noqa: PLC0415

    buffer = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context(_STYLE):
        figure.savefig(buffer, format="svg", transparent=True, dpi=200, metadata=nothing)
    text = buffer.getvalue()
    width, height = 72 * figure.get_size_inches()
    inside = text[text.index(">", text.index("<svg")) + 1 :]
    inside = re.sub(r"<style.*?</style>|<!--.*?-->", "", inside, flags=re.DOTALL)
    inside = re.sub(r'<g id="[^"]*"', "<g", inside)
    # figures share a page, so the names of their parts must differ
    prefix = hashlib.sha256(inside.encode()).hexdigest()[:12]
    inside = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}-", inside)
    inside = inside.replace(_INK, "var(--ink)").replace(_RULE, "var(--rule)")
    return f'<svg viewBox="0 0 {width:g} {height:g}" aria-hidden="true">{inside.strip()}'

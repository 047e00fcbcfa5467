"""Status and residuals over time, the last `Pace.history` frames of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np
import viser
from viser import uplot

from mixpose.pictures.overlay import BODY_COLOURS, STATUS_COLOURS
from mixpose.records import Floats
from mixpose.session import Session
from mixpose.viewing.moment import PACE, Row

_HEIGHT_PX = 170
_INK = "#bbbbbb"


class Series:
    """Plots that go along with a run; residuals that are lengths have one of their own."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._rows: deque[Row] = deque(maxlen=PACE.history)
        colours = [STATUS_COLOURS[status] for status in STATUS_COLOURS]
        self._status = _plot(gui, "bodies by status", list(STATUS_COLOURS), colours)
        self._residuals = []
        for unit in ("px", "length"):
            names = [one.name for one in session.sensors if one.sensor.unit == unit]
            if names:
                title = f"residual RMS, {unit if unit == 'px' else session.unit}"
                several = [BODY_COLOURS[k % len(BODY_COLOURS)] for k in range(len(names))]
                self._residuals.append((names, _plot(gui, title, names, several)))

    def add(self, rows: Iterable[Row]) -> None:
        """Go on with some frames."""
        self._rows.extend(rows)
        frames = np.array([row.frame for row in self._rows], dtype=np.float64)
        self._status.data = (
            frames,
            *(
                np.array([row.statuses.count(status) for row in self._rows], dtype=np.float64)
                for status in STATUS_COLOURS
            ),
        )
        for names, plot in self._residuals:
            plot.data = (frames, *(self._residuals_of(name) for name in names))

    def _residuals_of(self, name: str) -> Floats:
        return np.array([row.residuals.get(name, np.nan) for row in self._rows])


def _plot(
    gui: viser.GuiApi, title: str, names: list[str], colours: list[tuple[int, int, int]]
) -> viser.GuiUplotHandle:
    lines = [
        uplot.Series(label=name, stroke=f"rgb({red},{green},{blue})", width=1.5)
        for name, (blue, green, red) in zip(names, colours, strict=True)
    ]
    axis = uplot.Axis(stroke=_INK, grid={"stroke": "#444444"}, ticks={"stroke": "#444444"})
    return gui.add_uplot(
        # the page keeps what share of the frames is shown, which of no frames is nothing
        data=(np.arange(2.0), *(np.full(2, np.nan) for _ in names)),
        series=(uplot.Series(label="frame"), *lines),
        title=title,
        scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
        axes=(axis, axis),
        height=_HEIGHT_PX,
    )

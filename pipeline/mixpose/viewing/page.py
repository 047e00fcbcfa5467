"""The page: pictures of the sensors, status, plots, buttons, and the scene in space."""

from __future__ import annotations

import html
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import viser
from viser import uplot

from mixpose.body import Body
from mixpose.pictures.canvas import GREY, Picture, stacked, words
from mixpose.pictures.overlay import BODY_COLOURS, STATUS_COLOURS
from mixpose.pictures.scene import backdrop, draw_camera, draw_strips, room_for, with_bodies
from mixpose.records import Estimate, Status
from mixpose.sensors import CloudSensor
from mixpose.session import SensorSetup, Session
from mixpose.viewing.moment import PACE, Moment, PageMessage, Row, ShownFrame
from mixpose.viewing.scene import MAGNIFICATIONS, Scene

_SENSORS_PX, _CONTROL_PX = 460, 380
_JPEG_QUALITY = 80
_HEIGHT_PX = 170
_INK = "#bbbbbb"


class Page:
    """The page of a run; `send` asks the run to pause, go on or step; None if it cannot."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        send: Callable[[PageMessage], None] | None,
        *,
        paused: bool = False,
    ) -> None:
        self._server = server
        self._session = session
        self._last: Moment | None = None
        self._buttons: tuple[viser.GuiButtonHandle, ...] = ()
        self._lock = threading.RLock()  # clicks come from other threads
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label(f"mixpose: {session.path.name}")
        self._pictures = self._add_pictures()
        main = server.gui.main_panel
        main.dock_right()
        main.set_width(_CONTROL_PX)
        self._status = server.gui.add_html("<p>waiting for the first frame</p>")
        if send is not None:
            self._add_buttons(send, paused)
        self._series = Series(server.gui, session)
        self._scene = Scene(server, session)
        hint = "The ellipsoid that holds a position with 95 % is drawn so many times larger."
        self._magnified = server.gui.add_dropdown("covariance", MAGNIFICATIONS, hint=hint)
        self._magnified.on_update(self._on_magnified)

    def show(self, moment: Moment) -> None:
        """Show a frame; slow browsers get only the newest."""
        with self._lock:
            self._last = moment
            posed = with_bodies(self._session, moment.estimates)
            with self._server.atomic():
                for setup in self._session.sensors:
                    shown = moment.sensors.get(setup.name, ShownFrame(None))
                    drawn = self._draw(posed, setup, shown)
                    self._pictures[setup.name].image = drawn[:, :, ::-1]
                self._status.content = status_text(moment)
                self._series.add(moment.rows)
                before = self._scene.magnification
                self._scene.add(moment)
                if self._scene.magnification != before:
                    self._magnified.value = f"× {self._scene.magnification}"

    def end(self) -> None:
        """Show that this was the last frame, and remove the buttons."""
        if self._last is not None:
            self._status.content = status_text(self._last, ended=True)
        for button in self._buttons:
            button.visible = False
        self._server.flush()

    def _draw(
        self, posed: Sequence[tuple[Body, Estimate]], setup: SensorSetup, shown: ShownFrame
    ) -> Picture:
        if isinstance(setup.sensor, CloudSensor):
            picture = np.zeros((60, 320, 3), np.uint8)
            words(picture, "points in space", (10, 40), GREY)
            return picture
        if setup.sensor.dimension != 2:
            return stacked(draw_strips(posed, setup, shown.frame))
        cameras = sum(other.sensor.dimension == 2 for other in self._session.sensors)
        picture, part = backdrop(setup, shown.frame, room_for(cameras) if shown.zoom == 1 else None)
        part = replace(part, zoom=part.zoom * shown.zoom)
        picture = draw_camera(posed, setup, picture, part, shown.features)
        if shown.frame is None:
            words(picture, "no frame", (10, picture.shape[0] - 10), GREY)
        return picture

    def _add_pictures(self) -> dict[str, viser.GuiImageHandle]:
        panel = self._server.gui.add_panel()
        blank = np.zeros((120, 160, 3), np.uint8)
        with panel.add_tab("sensors"):
            pictures = {
                setup.name: self._server.gui.add_image(
                    blank, label=setup.name, format="jpeg", jpeg_quality=_JPEG_QUALITY
                )
                for setup in self._session.sensors
            }
        panel.dock_left()
        panel.set_width(_SENSORS_PX)
        return pictures

    def _add_buttons(self, send: Callable[[PageMessage], None], paused: bool) -> None:
        gui = self._server.gui
        self._buttons = pause, go_on, step = (
            gui.add_button("Pause", hint="The run waits after this frame.", visible=not paused),
            gui.add_button("Go on", visible=paused),
            gui.add_button("Step", hint="One frame, then wait."),
        )

        def on(button: viser.GuiButtonHandle, action: PageMessage) -> None:
            def clicked(_: object) -> None:
                pause.visible, go_on.visible = action == "go on", action != "go on"
                send(action)

            button.on_click(clicked)

        on(pause, "pause")
        on(go_on, "go on")
        on(step, "step")

    def _on_magnified(self, _: object) -> None:
        with self._lock:
            self._scene.magnification = int(self._magnified.value.split()[-1])
            if self._last is not None:
                self._scene.draw_ellipsoids(self._last.estimates)


def status_text(moment: Moment, *, ended: bool = False) -> str:
    """Return the status of a frame as HTML; names of the session are escaped."""
    first = moment.estimates[0]
    when = "" if first.time_s is None else f", {first.time_s:.3f} s"
    counts = ", ".join(f"{moment.counts.get(s, 0)} {_coloured(s)}" for s in STATUS_COLOURS)
    speed = f"{moment.per_second:.3g} frames a second" if moment.per_second else "one at a time"
    speed = "done" if ended else speed
    rows = ""
    for estimate in moment.estimates:
        confidence = "" if estimate.confidence is None else f"{estimate.confidence:.4f}"
        doubt = f" title='{html.escape(estimate.doubt, quote=True)}'" if estimate.doubt else ""
        rows += (
            f"<tr{doubt}><td>{html.escape(estimate.label)}</td><td>{_coloured(estimate.status)}</td>"
            f"<td>{confidence}</td><td>{estimate.score:.2f}</td></tr>"
        )
    return (
        f"<div style='padding: 0 0.8em; font-size: 0.9em'><b>frame {first.frame}</b>{when}"
        f"<br>{counts}<br>{speed}, {first.latency_ms:.3g} ms for this one"
        "<table style='width: 100%; text-align: left'><tr><th>body</th><th>status</th>"
        f"<th>confidence</th><th>score</th></tr>{rows}</table></div>"
    )


def _coloured(status: Status) -> str:
    blue, green, red = STATUS_COLOURS[status]
    return f"<span style='color: rgb({red}, {green}, {blue})'>{status}</span>"


class Series:
    """Plots of a run over time; residuals in px and in lengths have separate plots."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._rows: deque[Row] = deque(maxlen=PACE.history)
        colours = [STATUS_COLOURS[status] for status in STATUS_COLOURS]
        self._status = _plot(gui, "bodies by status", list(STATUS_COLOURS), colours)
        self._residuals = []
        for unit in ("px", "length"):
            names = [setup.name for setup in session.sensors if setup.sensor.unit == unit]
            if names:
                title = f"residual RMS, {unit if unit == 'px' else session.unit}"
                palette = [BODY_COLOURS[k % len(BODY_COLOURS)] for k in range(len(names))]
                self._residuals.append((names, _plot(gui, title, names, palette)))

    def add(self, rows: Iterable[Row]) -> None:
        """Add frames to the plots."""
        self._rows.extend(rows)
        frames = np.array([row.frame for row in self._rows], dtype=np.float64)
        counts = [[row.statuses.count(s) for row in self._rows] for s in STATUS_COLOURS]
        self._status.data = (frames, *np.array(counts, dtype=np.float64))
        for names, plot in self._residuals:
            residuals = [[row.residuals.get(name, np.nan) for row in self._rows] for name in names]
            plot.data = (frames, *map(np.array, residuals))


def _plot(
    gui: viser.GuiApi, title: str, names: list[str], colours: list[tuple[int, int, int]]
) -> viser.GuiUplotHandle:
    lines = [
        uplot.Series(label=name, stroke=f"rgb({red},{green},{blue})", width=1.5)
        for name, (blue, green, red) in zip(names, colours, strict=True)
    ]
    axis = uplot.Axis(stroke=_INK, grid={"stroke": "#444444"}, ticks={"stroke": "#444444"})
    return gui.add_uplot(
        # the page keeps the share of the frames that is shown, which needs some frames
        data=(np.arange(2.0), *(np.full(2, np.nan) for _ in names)),
        series=(uplot.Series(label="frame"), *lines),
        title=title,
        scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
        axes=(axis, axis),
        height=_HEIGHT_PX,
    )

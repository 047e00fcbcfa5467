"""Write a recording for the Rerun viewer: frames of the sensors, their features, and the poses.

`docs/formats.md` lists what is logged: sensors with their images and bodies with their features
below ``world``, g_l below ``density``, ``plots/score`` and ``status``.  With several bodies, the
last two and ``predicted`` end in the body's name.  Lengths are in the session's unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mixpose import rigid
from mixpose.density import Observation, Window, render
from mixpose.frames import Source, pair
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats, FrameSet, GridPattern, Image, PointPattern
from mixpose.runner import observation_of
from mixpose.sensors import FisheyeCamera, PinholeCamera, RangeSensor
from mixpose.session import SensorSetup, Session

_COLOURS = {"ok": (80, 200, 120), "ambiguous": (255, 170, 40)}
_BODY_COLOURS = (
    *((80, 200, 120), (60, 150, 255), (255, 90, 200), (255, 220, 60)),
    *((90, 230, 230), (255, 120, 150), (140, 200, 120), (190, 120, 255)),
)
_FOUND = (90, 170, 255)
_DENSITY_WIDTH = 640
_JPEG_QUALITY = 85
# Rerun has the corners of pixels at integers
_HALF = 0.5


def write_rerun_file(
    path: Path, session: Session, sources: Mapping[str, Source], lines: Sequence[PoseLine]
) -> None:
    """Write the recording of the frames that have a pose line.

    Sources are open; lines have ascending frame numbers, and are in the unit of the session that
    estimated them. Raises `RecordingError` if a frame cannot be read; the file then holds the
    frames before it.
    """
    stream = rr.RecordingStream("mixpose", send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.save(path, default_blueprint=_blueprint(session))
    try:
        scene = _Scene(stream, session)
        scene.log_static(lines)
        scene.play(sources, lines)
    finally:
        stream.flush()
        stream.disconnect()


@dataclass(frozen=True)
class _Scene:
    """Log of a session to a stream."""

    stream: Any
    session: Session

    def log_static(self, lines: Sequence[PoseLine]) -> None:
        """Log what does not move: sensors, and the object's features in its own frame."""
        for setup in self.session.sensors:
            self._sensor(setup, lines)
        # no radii: static ones would overrule those that hide the points of a lost body
        for model in self.session.objects:
            for label in model.labels:
                points = rr.Points3D(model.body.means)
                self.stream.log(["world", label, "points"], points, static=True)

    def play(self, sources: Mapping[str, Source], lines: Sequence[PoseLine]) -> None:
        """Log frame by frame; poses of frames that no source has come last."""
        waiting: dict[int, list[PoseLine]] = {}
        for line in lines:
            waiting.setdefault(line.frame, []).append(line)
        if waiting:
            for frame_set in pair(sources, min(waiting), max(waiting) + 1):
                if frame_set.number in waiting:
                    self._moment(waiting.pop(frame_set.number), frame_set)
        for remaining in waiting.values():
            self._moment(remaining, None)

    def _moment(self, lines: Sequence[PoseLine], frames: FrameSet | None) -> None:
        self.stream.reset_time()
        self.stream.set_time("frame", sequence=lines[0].frame)
        if lines[0].time_s is not None:
            self.stream.set_time("time", duration=lines[0].time_s)
        for setup in self.session.sensors:
            if frames is not None and setup.name in frames.frames:
                self._seen(setup, frames)
        for line in lines:
            self._pose(line)

    def _sensor(self, setup: SensorSetup, lines: Sequence[PoseLine]) -> None:
        sensor = setup.sensor
        place = ["world", setup.name]
        if isinstance(sensor, RangeSensor):
            self.stream.log(place, rr.Points3D([sensor.position], labels=[setup.name]), static=True)
            return
        if not isinstance(sensor, PinholeCamera | FisheyeCamera):
            return
        T_world_sensor = rigid.inverse(sensor.T_sensor_world)
        self.stream.log(place, _transform(T_world_sensor), static=True)
        K = sensor.camera_matrix.copy()
        K[:2, 2] += _HALF
        resolution = sensor.resolution or tuple(np.round(2 * K[:2, 2]).astype(int))
        origins = [line.T_world_object for line in lines if line.T_world_object is not None]
        away = [np.linalg.norm(T[:3, 3] - T_world_sensor[:3, 3]) for T in origins[:1]]
        self.stream.log(
            [*place, "image"],
            rr.Pinhole(
                image_from_camera=K,
                resolution=resolution,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.4 * float(away[0]) if away else None,
            ),
            static=True,
        )

    def _seen(self, setup: SensorSetup, frames: FrameSet) -> None:
        """Log the frame of one sensor, its features and their density."""
        frame = frames.frames[setup.name]
        size = setup.resolution
        place = ["world", setup.name, "image"]
        if not isinstance(frame.data, PointPattern | GridPattern):
            self.stream.log(place, _jpeg(_eight_bits(frame.data)))
            size = (frame.data.shape[1], frame.data.shape[0])
        observation = observation_of(self.session, setup, frame)
        pattern = observation.pattern
        if isinstance(pattern, PointPattern) and pattern.dimension == 2:
            points, radius = pattern.points + _HALF, rr.Radius.ui_points(4)
            self.stream.log([*place, "features"], rr.Points2D(points, radii=radius, colors=_FOUND))
        density = _density(observation, size)
        if density is not None:
            self.stream.log(["density", setup.name], density)

    def _pose(self, line: PoseLine) -> None:
        # each of several bodies has its own entities
        names = [line.label] if len(self.session.labels) > 1 else []
        label = f"{line.label} " if names else ""
        score = line.score if line.score is not None else 1.0
        self.stream.log(["plots", "score", *names], rr.Scalars(score))
        self.stream.log(["status", *names], rr.TextLog(f"frame {line.frame}: {label}{line.status}"))
        places = ["world", line.label], ["world", f"{line.label} covariance"]
        T = line.T_world_object
        predicted = [
            ["world", setup.name, "image", "predicted", *names] for setup in self.session.sensors
        ]
        if T is None:
            for place in (*places, *predicted):
                self.stream.log(place, rr.Clear(recursive=False))
            # without a transform the points would be at the world's origin: hide them
            self.stream.log(["world", line.label, "points"], rr.Points3D.from_fields(radii=[0.0]))
            return
        bodies = {model.body.name: model.body for model in self.session.objects}
        body = bodies.get(line.object, self.session.body)
        colour = _COLOURS[line.status]
        labels = self.session.labels
        if names and line.status == "ok" and line.label in labels:
            colour = _BODY_COLOURS[labels.index(line.label) % len(_BODY_COLOURS)]
        self.stream.log(places[0], _transform(T))
        shown = rr.Points3D.from_fields(radii=[0.03 * body.radius], colors=[colour])
        self.stream.log([*places[0], "points"], shown)
        if line.covariance is None:
            self.stream.log(places[1], rr.Clear(recursive=False))
        else:
            # it holds the position with 95 %
            half_axes, axes = rigid.position_ellipsoid_95(line.covariance)
            turn = rigid.quaternion_xyzw(rigid.from_parts(axes, np.zeros(3)))
            ellipsoid = rr.Ellipsoids3D(
                half_sizes=[half_axes],
                centers=[T[:3, 3]],
                quaternions=[rr.Quaternion(xyzw=turn)],
                colors=[colour],
            )
            self.stream.log(places[1], ellipsoid)
        world = rigid.transform(T, body.means)
        for setup, place in zip(self.session.sensors, predicted, strict=True):
            if setup.sensor.dimension == 2:
                points, seen = setup.sensor.project(world)
                radius = rr.Radius.ui_points(2)
                self.stream.log(
                    place, rr.Points2D(points[seen] + _HALF, radii=radius, colors=colour)
                )


def _transform(T_parent_child: Floats) -> Any:
    return rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])


def _eight_bits(image: Image) -> NDArray[np.uint8]:
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    top = 65535.0 if image.dtype == np.uint16 else max(float(image.max()), 1e-12)
    return np.asarray(np.clip(image * (255.0 / top), 0, 255), dtype=np.uint8)


def _jpeg(image: NDArray[np.uint8]) -> Any:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")


def _density(observation: Observation, size: tuple[int, int] | None) -> Any:
    """Draw g_l over the whole sensor; return None without features."""
    if observation.is_empty:
        return None
    lower, upper = observation.extent
    margin = 4 * observation.sigma
    lower, upper = lower - margin, upper + margin
    if observation.dimension == 2 and size is not None:
        lower, upper = np.zeros(2), np.array(size) - 1.0
    step = max(float(upper[0] - lower[0]) / _DENSITY_WIDTH, observation.sigma / 4)
    blur = np.sqrt(max(observation.sigma**2 - observation.intrinsic**2, (0.5 * step) ** 2))
    window = Window.around(lower, upper, step)
    values = render(observation.pattern, float(blur), window).values
    if observation.dimension == 1:
        return rr.BarChart(values.ravel(), abscissa=window.axis(0))
    return _jpeg(_eight_bits(np.sqrt(np.maximum(values, 0.0))))


def _blueprint(session: Session) -> Any:
    """Lay out the world beside the sensors' images and densities."""
    world = rrb.Spatial3DView(origin="/world", name="world")
    cameras = [setup.name for setup in session.sensors if setup.sensor.dimension == 2]
    part = {name: rr.escape_entity_path_part(name) for name in cameras}
    rows = [
        rrb.Horizontal(
            rrb.Spatial2DView(origin=f"/world/{part[name]}/image", name=name),
            rrb.Spatial2DView(origin=f"/density/{part[name]}", name=f"density {name}"),
        )
        for name in cameras
    ]
    views = [world, rrb.Vertical(*rows)] if rows else [world]
    return rrb.Blueprint(rrb.Horizontal(*views), collapse_panels=True)

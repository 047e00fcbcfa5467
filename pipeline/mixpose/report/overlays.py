"""Draw poses on a few frames of the recording."""

from __future__ import annotations

import base64
from collections.abc import Generator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass

import cv2
import numpy as np

from mixpose.errors import MixposeError, RecordingError
from mixpose.frames import Source, open_source, pair
from mixpose.frames.capture import is_stream
from mixpose.pictures import Part, displayable, draw_pose
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.records import FrameSet, Image, PointPattern, RawFrame, Status
from mixpose.report.series import Errors, Series
from mixpose.rigid import transform
from mixpose.runner import observation_of, source_spec
from mixpose.session import SensorSetup, Session

_EVENLY = 4  # evenly spaced frames, besides the best, the worst and a lost one
_MOST_CAMERAS = 6  # the page must stay small
_WIDEST = 720  # px
_JPEG_QUALITY = 80
_MARGIN = 2.0  # size of the shown surroundings, by that of the object
_MOST_SHARE = 0.7  # of an image; for larger surroundings all of it is shown
_LEAST_PX = 120  # of the camera; in smaller surroundings only pixels are seen
_LARGEST_ZOOM = 4.0


@dataclass(frozen=True)
class Shot:
    """A camera's frame with the pose drawn on it."""

    sensor: str
    uri: str  # contains the whole JPEG
    width: int  # of the JPEG, px
    height: int
    zoom: float  # pixels of the JPEG per pixel of the camera
    is_part: bool  # whether it shows only the surroundings of the object


@dataclass(frozen=True)
class OverlayFrame:
    """The shots of one frame number, and why it was chosen ("" for an evenly spaced one)."""

    frame: int
    status: Status
    why: str
    shots: tuple[Shot, ...]


def overlay_frames(
    session: Session | None, poses: PoseFile, series: Series, errors: Errors | None
) -> tuple[list[OverlayFrame], list[str]]:
    """Draw poses on selected frames, ascending; also return sentences on what cannot be read."""
    if session is None:
        return [], []
    opened, notices = _open(session, poses.sources)
    chosen = chosen_frames(series, errors)
    setups = {setup.name: setup for setup in session.sensors}
    lines = {line.frame: line for line in poses.poses}
    frames: list[OverlayFrame] = []
    if not opened or not chosen:
        return frames, notices
    try:
        with closing(_read(opened, chosen)) as frame_sets:
            for frame_set in frame_sets:
                line = lines[frame_set.number]
                shots = tuple(
                    _shot(session, setups[name], frame, frame.data, line)
                    for name, frame in frame_set.frames.items()
                    if isinstance(frame.data, np.ndarray)
                )
                frames.append(OverlayFrame(line.frame, line.status, chosen[line.frame], shots))
    except RecordingError as error:
        notices.append(f"The recording cannot be read to the end: {error}")
    absent = sorted(set(chosen) - {frame.frame for frame in frames})
    if absent and not notices:
        notices.append(f"The recording has no frame {', '.join(map(str, absent))} any more.")
    return frames, notices


def chosen_frames(series: Series, errors: Errors | None) -> dict[int, str]:
    """Select frames, with reasons: evenly spaced ones, best, worst and the first lost frame."""
    count = len(series.frames)
    if not count:
        return {}
    evenly = np.linspace(0, count - 1, min(_EVENLY, count))
    reasons: dict[int, list[str]] = {round(i): [] for i in evenly}
    if errors is None:
        badness, words = -series.score, ("best score", "worst score")
    else:
        badness, words = errors.rotation_deg, ("smallest rotation error", "largest rotation error")
    is_lost = series.status == "lost"
    badness = np.where(is_lost, np.nan, badness)
    if np.isfinite(badness).any():
        reasons.setdefault(int(np.nanargmin(badness)), []).append(words[0])
        reasons.setdefault(int(np.nanargmax(badness)), []).append(words[1])
    if is_lost.any():
        reasons.setdefault(int(is_lost.argmax()), []).append("first lost frame")
    return {series.frames[i]: ", ".join(why) for i, why in sorted(reasons.items())}


def _open(session: Session, replaced: Mapping[str, str]) -> tuple[dict[str, Source], list[str]]:
    """Open the recordings with images, and return notices; a stream cannot be read again."""
    opened: dict[str, Source] = {}
    notices: list[str] = []
    for setup in session.sensors:
        replacement = replaced.get(setup.name)
        if setup.model == "lateration" or not (replacement or setup.source):
            continue
        spec = source_spec(session, setup, replacement)
        names = (spec.source,) if isinstance(spec.source, str) else spec.source
        if any("://" in name or is_stream(str(spec.base / name)) for name in names):
            continue
        if len(opened) == _MOST_CAMERAS:
            notices.append(f"Only the first {_MOST_CAMERAS} cameras are shown.")
            break
        try:
            source = open_source(spec)
        except MixposeError as error:
            notices.append(f"The recording of {setup.name} cannot be read again: {error}")
            continue
        if source.kind in ("images", "video"):
            opened[setup.name] = source
    return opened, notices


def _read(
    opened: Mapping[str, Source], wanted: Mapping[int, str]
) -> Generator[FrameSet, None, None]:
    """Read the wanted frames of all recordings, by number."""
    if any(source.kind == "video" for source in opened.values()):
        # in one pass: to reach a frame of a video, all frames before it are decoded
        for frame_set in pair(opened, min(wanted), max(wanted) + 1):
            if frame_set.number in wanted:
                yield frame_set
        return
    for number in sorted(wanted):
        yield from pair(opened, number, number + 1)


def _shot(
    session: Session, setup: SensorSetup, frame: RawFrame, image: Image, line: PoseLine
) -> Shot:
    """Draw a pose on a camera's frame, cut to the surroundings of the object, as a JPEG."""
    picture = displayable(image)
    height, width = picture.shape[:2]
    (left, top), (right, bottom) = _surroundings(session, setup, line, width, height)
    is_part = (right - left, bottom - top) != (width, height)
    zoom = min(_WIDEST / (right - left), _LARGEST_ZOOM if is_part else 1.0)
    size = round((right - left) * zoom), max(round((bottom - top) * zoom), 1)
    interpolation = cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC
    part, scaled = Part(zoom, (left, top)), picture[top:bottom, left:right]
    scaled = np.asarray(cv2.resize(scaled, size, interpolation=interpolation), dtype=np.uint8)
    detections = None  # extracted as in the run
    with suppress(MixposeError):  # the pose can be drawn without them
        pattern = observation_of(session, setup, frame).pattern
        detections = pattern.points if isinstance(pattern, PointPattern) else None
    posed = line.T_world_object, line.covariance, line.status, line.frame
    drawn = draw_pose(scaled, setup.sensor, session.body, *posed, part=part, detections=detections)
    _, jpeg = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    uri = f"data:image/jpeg;base64,{base64.b64encode(jpeg.tobytes()).decode('ascii')}"
    return Shot(setup.name, uri, *size, zoom, is_part)


def _surroundings(
    session: Session, setup: SensorSetup, line: PoseLine, width: int, height: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return corners of the part of an image to show: around a small object, else all of it."""
    whole = (0, 0), (width, height)
    if line.T_world_object is None:
        return whole
    y, inside = setup.sensor.project(transform(line.T_world_object, session.body.means))
    if not inside.any():
        return whole
    low, high = y[inside].min(axis=0), y[inside].max(axis=0)
    size = np.array([width, height])
    share = max(_MARGIN * float(((high - low) / size).max()), _LEAST_PX / width)
    if share > _MOST_SHARE:
        return whole
    corner = np.clip(np.round((low + high - share * size) / 2), 0, size - np.ceil(share * size))
    end = np.minimum(corner + np.ceil(share * size), size)
    return (int(corner[0]), int(corner[1])), (int(end[0]), int(end[1]))

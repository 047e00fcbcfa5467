"""Open the source that a session names.

A new kind of source is a file with its class, a line in `_OPENERS` and a rule in `_recognise`.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Sequence
from difflib import SequenceMatcher
from pathlib import Path

import numpy as np

from mixpose.errors import RecordingError, SessionError
from mixpose.frames.capture import is_pipe
from mixpose.frames.images import IMAGE_SUFFIXES, natural_order, open_images
from mixpose.frames.live import live_address, open_live
from mixpose.frames.profiles import open_profiles
from mixpose.frames.source import SensorKind, Source, SourceKind, SourceSpec
from mixpose.frames.tables import open_table
from mixpose.frames.times import Clock, clock_of, csv_rows
from mixpose.frames.video import open_video

_STREAM = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)  # a single letter is a drive
_MOST_NAMES = 4  # names of files that a message lists

_OPENERS: dict[SourceKind, Callable[[SourceSpec, list[str], Clock | None], Source]] = {
    "images": lambda spec, places, clock: open_images(spec, [Path(p) for p in places], clock),
    "video": lambda spec, places, clock: open_video(spec, places[0], clock),
    "live": lambda spec, places, clock: open_live(spec, places[0], clock),
    "detections": lambda spec, places, clock: open_table(spec, Path(places[0]), clock),
    "profiles": lambda spec, places, clock: open_profiles(spec, Path(places[0]), clock),
}

_FIT_FOR: dict[SensorKind, tuple[set[SourceKind], str]] = {
    "camera": (
        {"images", "video", "live", "detections"},
        "images, a video, a camera or a .csv table of detections with columns u,v",
    ),
    "lateration": (
        {"detections", "profiles"},
        "a .csv table of detections with a column range, or range profiles (.npy or .csv)",
    ),
    "cloud": ({"detections"}, "a .csv table of points with columns x,y,z"),
}


def numbers_of(source: Source) -> set[int] | None:
    """Return the frame numbers of a recording; None if only decoding it would tell."""
    numbers = source.known_numbers()
    return None if numbers is None else set(numbers)


def spread_over(numbers: Sequence[int], most: int, run: int = 1) -> list[int]:
    """Select at most `most` numbers, evenly from first to last, in runs of neighbours."""
    starts = np.linspace(0, len(numbers) - run, min(most, len(numbers)) // run)
    return [numbers[int(start) + k] for start in starts for k in range(run)]


def open_source(spec: SourceSpec) -> Source:
    """Find and open a recording; SessionError if options do not fit it, else RecordingError."""
    clock = clock_of(spec)
    try:
        kind, places = _recognise(spec)
    except OSError as error:
        raise RecordingError(
            f"{error.filename}: cannot be read: {error.strerror}; source of {spec.sensor!r}"
        ) from error
    kinds, text = _FIT_FOR[spec.kind]
    if kind not in kinds:
        raise SessionError(
            f"sensor {spec.sensor!r}: source: found {kind} ({places[0]}), a {spec.kind} sensor "
            f"reads {text}"
        )
    return _OPENERS[kind](spec, places, clock)


def files_of(spec: SourceSpec) -> list[str]:
    """Return the files of a recording, or a live address; RecordingError if there is none."""
    return _recognise(spec)[1]


def _recognise(spec: SourceSpec) -> tuple[SourceKind, list[str]]:
    """Return the kind of a source, and the files or the address that it is read from."""
    source = spec.source
    if not isinstance(source, str) and len(source) == 1:
        source = source[0]
    if not isinstance(source, str):
        return "images", _listed(spec, source)
    if live_address(source) is not None:
        return "live", [source]
    if _STREAM.match(source):
        return "video", [source]
    path = spec.base / source
    if source and path.is_dir():
        images = [file for file in path.iterdir() if _is_image(file) and file.is_file()]
        if not images:
            raise RecordingError(f"{path}: no images in this folder; {_looked_in(path / '*')}")
        return "images", list(map(str, natural_order(images)))
    if is_pipe(str(path)) or path.is_file():
        return _kind_of_file(spec, path), [str(path)]
    kind, files = _matches(spec, source)
    return kind, list(map(str, files))


def _listed(spec: SourceSpec, source: Sequence[str]) -> list[str]:
    if not source:
        raise SessionError(f"sensor {spec.sensor!r}: source: found an empty list of images")
    paths = [spec.base / name for name in source]
    for path in paths:
        if not path.is_file():
            raise RecordingError(
                f"{path}: no such file, named in the source of {spec.sensor!r}; {_looked_in(path)}"
            )
    return list(map(str, paths))


def _matches(spec: SourceSpec, pattern: str) -> tuple[SourceKind, list[Path]]:
    """Return the files that a glob matches: the images among them, else a single other file."""
    path = spec.base / pattern
    # unlike Path.glob, this takes absolute patterns
    matches = glob.glob(pattern, root_dir=spec.base, recursive=True)  # noqa: PTH207
    paths = [spec.base / match for match in matches]
    files = [match for match in paths if match.is_file()]
    images = [file for file in files if _is_image(file)]
    if images:
        return "images", natural_order(images)
    if len(files) == 1:
        return _kind_of_file(spec, files[0]), files
    if files:
        raise RecordingError(
            f"{path}: matches {len(files)} files and none is an image (the first is "
            f"{min(files).name}); allowed are images or one other file"
        )
    as_pattern = ", as [ ] stand for one of the characters in them: [[] is a [" * ("[" in pattern)
    raise RecordingError(
        f"{path}: no such file, and nothing matches{as_pattern}; source of {spec.sensor!r}; "
        f"{_looked_in(path)}"
    )


def _looked_in(path: Path) -> str:
    """Describe the folder where a file was looked for, and its contents."""
    folder = path.parent
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    # dots and the working directory are resolved, as they may be the mistake
    text = f"looked in {folder.resolve()}"
    if folder != path.parent and not glob.has_magic(str(path.parent)):
        return f"there is no folder {path.parent.resolve()}"
    try:
        entries = natural_order([entry for entry in folder.iterdir() if entry.name[:1] != "."])
    except OSError as error:
        return f"{text}, which cannot be read: {error.strerror}"
    # of files that differ in numbers alone, show the first
    kinds = {re.sub(r"[0-9]+", "0", entry.name): entry.name for entry in reversed(entries)}
    names, wanted = list(kinds.values())[::-1], path.name.lower()
    names.sort(key=lambda name: -round(SequenceMatcher(None, name.lower(), wanted).ratio(), 1))
    shown = ", ".join(names[:_MOST_NAMES])
    more = f", ... ({len(entries)} in all)" if len(entries) > min(len(kinds), _MOST_NAMES) else ""
    return f"{text}, where there is {shown}{more}" if entries else f"{text}, which is empty"


def _is_image(path: Path) -> bool:
    # copies by macOS leave files ._name.png, which are no images
    return path.suffix.casefold() in IMAGE_SUFFIXES and not path.name.startswith(".")


def _kind_of_file(spec: SourceSpec, path: Path) -> SourceKind:
    suffix = "" if is_pipe(str(path)) else path.suffix.casefold()
    if suffix in IMAGE_SUFFIXES:
        return "images"
    if suffix == ".npy":
        return "profiles"
    if suffix != ".csv":
        return "video"
    if spec.kind == "lateration" and _all_numbers(path):
        return "profiles"
    return "detections"


def _all_numbers(path: Path) -> bool:
    """Test whether the first row is a profile and not a header."""
    _, cells = next(csv_rows(path), (0, []))
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False

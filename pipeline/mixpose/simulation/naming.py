"""Choose the files of a simulated recording, so that the copied session reads them unchanged.

A glob becomes images with the frame number in place of its last ``*``, a folder is filled with
numbered images, a list gives its own names, and a video or a table is one file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import permutations
from pathlib import Path, PurePosixPath
from typing import Literal, TypeAlias

from mixpose.errors import SessionError
from mixpose.frames.images import IMAGE_SUFFIXES, frame_numbers
from mixpose.session import SensorSetup

Kind: TypeAlias = Literal["images", "video", "profiles", "detections"]

VIDEO_SUFFIXES = (".avi", ".mp4")
IMAGES_WRITTEN = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")
_OTHER_VIDEOS = (".mkv", ".mov", ".m4v", ".webm", ".wmv", ".mpg", ".mpeg", ".h264", ".flv", ".ts")
_WILD = re.compile(r"\*\*/|\*|\?|\[!?[^\]]+\]")
_SINGLES = re.compile(r"(?:\?|\[!?[^\]]+\])+")
_FEWEST_DIGITS = 4


@dataclass(frozen=True)
class SourceFiles:
    """The files of one sensor, relative to the recording's folder."""

    sensor: str  # name
    kind: Kind
    path: str  # the file of a video or table; of images the text before the frame number
    ending: str = ""  # of images: the text after the frame number
    digits: int = 0  # of images: the least number of digits of the frame number
    listed: dict[int, str] = field(default_factory=dict)  # of images of a list: names by frame
    pattern: str = ""  # the glob by which the session reads the images; empty for other sources

    def name(self, number: int) -> str:
        """Return the name of the file that holds a frame."""
        if self.kind != "images":
            return self.path
        return self.listed.get(number) or f"{self.path}{number:0{self.digits}d}{self.ending}"

    @property
    def may_lack_frames(self) -> bool:
        """Whether a frame may be missing, as the others state their own numbers."""
        if self.kind == "images":
            return not self.listed and self.ending == PurePosixPath(f"0{self.ending}").suffix
        return self.kind == "detections"

    @property
    def counts_from_zero(self) -> bool:
        """Whether frames are numbered by their position."""
        return not self.may_lack_frames and not self.listed

    def existing(self, folder: Path) -> Iterator[Path]:
        """Yield files in a folder that the session would read as this source."""
        if self.pattern:
            yield from (path for path in folder.glob(self.pattern) if path.is_file())
        elif self.kind == "images" and not self.listed:
            paths = (folder / self.path).glob("*")
            yield from (path for path in paths if path.suffix.casefold() in IMAGE_SUFFIXES)
        else:
            names = self.listed.values() if self.listed else [self.path]
            yield from (path for path in (folder / name for name in names) if path.is_file())

    def reads(self, name: str) -> bool:
        """Test whether the session would read a file of this name as part of this source."""
        if self.pattern:
            return _matches(self.pattern, name)
        if self.kind == "images" and not self.listed:
            return str(PurePosixPath(name).parent) == str(PurePosixPath(self.path))
        return name in (self.listed.values() if self.listed else [self.path])


Source: TypeAlias = str | tuple[str, ...]
Sources: TypeAlias = Sequence[tuple[SensorSetup, Source]]


def plan_files(sources: Sources, frames: int) -> tuple[Sequence[int], tuple[SourceFiles, ...]]:
    """Choose the files of a recording, for sources inside its folder.

    The frame numbers, ascending, are those of lists of images, else they count from 0.  Raises a
    `SessionError` if these sources would read no files that can be written.
    """
    single = [
        (setup, source[0] if isinstance(source, tuple) and len(source) == 1 else source)
        for setup, source in sources
    ]
    numbers = _frame_numbers(single, frames)
    files = tuple(_source_files(setup, source, numbers) for setup, source in single)
    for target in files:
        if target.counts_from_zero and numbers[-1] != frames - 1:
            raise SessionError(
                f"{_where(target.sensor)}: counts frames from 0, while a list of images of another "
                f"sensor has the numbers {numbers[0]} to {numbers[-1]}; use numbered images"
            )
    for first, other in permutations(files, 2):
        name = first.name(numbers[0])
        if other.reads(name):
            raise SessionError(
                f"{_where(other.sensor)}: would also read {name} of sensor {first.sensor!r}; give "
                "each sensor files of its own"
            )
    return numbers, files


def _where(sensor: str) -> str:
    return f"sensor {sensor!r}: source"


def _frame_numbers(sources: Sources, frames: int) -> Sequence[int]:
    numbers: Sequence[int] = range(frames)
    listed_by = ""
    for setup, source in sources:
        names = _image_names(source)
        if not names or setup.sensor.dimension != 2:
            continue
        if len(names) != frames:
            raise SessionError(
                f"{_where(setup.name)}: names {len(names)} image{'s' * (len(names) != 1)}; "
                f'allowed: one per frame ({frames}), or a glob like "{setup.name}*.png"'
            )
        listed = sorted(frame_numbers([Path(name) for name in names]))
        if listed_by and listed != numbers:
            raise SessionError(
                f"{_where(setup.name)}: has other frame numbers than that of {listed_by!r}; name "
                "the images of one moment by the same number"
            )
        numbers, listed_by = listed, setup.name
    return numbers


def _image_names(source: Source) -> tuple[str, ...]:
    """Return the names of images that the session lists one by one."""
    if isinstance(source, tuple):
        return source
    is_image = PurePosixPath(source).suffix.casefold() in IMAGE_SUFFIXES
    return (source,) if is_image and not _WILD.search(source) else ()


def _source_files(setup: SensorSetup, source: Source, numbers: Sequence[int]) -> SourceFiles:
    if not source:
        raise SessionError(
            f'{_where(setup.name)}: missing; name what is to be written, like "{setup.name}*.png"'
        )
    if setup.sensor.dimension != 2:
        return _table_files(setup, source)
    files = _camera_files(setup.name, source, numbers)
    if files.path.casefold().endswith(".mp4") and any(n % 2 for n in setup.resolution or ()):
        raise SessionError(
            f"{_where(setup.name)}: found {source!r} for images of {setup.resolution} px; .mp4 "
            "needs an even width and height, .avi and images do not"
        )
    return files


def _table_files(setup: SensorSetup, source: Source) -> SourceFiles:
    path = _filled(source) if isinstance(source, str) else ""
    suffix = PurePosixPath(path).suffix.casefold()
    are_ranges, binned = setup.sensor.dimension == 1, setup.bin_size is not None
    if are_ranges and suffix == ".npy" and not binned:
        raise SessionError(
            f"sensor {setup.name!r}: bin_size: missing; profiles ({path}) need "
            "range_min and bin_size"
        )
    if are_ranges and (suffix == ".npy" or (suffix == ".csv" and binned)):
        return SourceFiles(setup.name, "profiles", path)
    if suffix == ".csv":
        return SourceFiles(setup.name, "detections", path)
    allowed = "ranges: a .csv table, or profiles as .npy or .csv"
    allowed = allowed if are_ranges else "clouds: a .csv table"
    raise SessionError(f"{_where(setup.name)}: found {source!r}; allowed for {allowed}")


def _camera_files(sensor: str, source: Source, numbers: Sequence[int]) -> SourceFiles:
    names = _image_names(source)
    if names:
        if len(set(names)) != len(names):
            raise SessionError(f"{_where(sensor)}: names an image twice; allowed: one per frame")
        for name in names:
            _check_format(name, sensor)
        listed_numbers = frame_numbers([Path(name) for name in names])
        return SourceFiles(sensor, "images", "", listed=dict(sorted(zip(listed_numbers, names))))
    assert isinstance(source, str)
    suffix = PurePosixPath(source).suffix.casefold()
    if suffix == ".csv":
        return SourceFiles(sensor, "detections", _filled(source))
    if suffix in VIDEO_SUFFIXES:
        return SourceFiles(sensor, "video", _filled(source))
    is_live = "://" in source or source.startswith("camera:")
    if suffix in _OTHER_VIDEOS or suffix == ".npy" or is_live:
        raise SessionError(
            f"{_where(sensor)}: found {source!r}; simulate writes images, .avi, .mp4 and .csv"
        )
    if _WILD.search(source):
        return _globbed_images(sensor, source, numbers)
    digits = max(_FEWEST_DIGITS, len(str(numbers[-1])))
    return SourceFiles(sensor, "images", source.rstrip("/") + "/", ".png", digits)


def _globbed_images(sensor: str, pattern: str, numbers: Sequence[int]) -> SourceFiles:
    head, dot, suffix = pattern.rpartition(".")
    concrete = pattern
    if not dot or "/" in suffix:
        concrete = f"{pattern}.png"
    elif _WILD.search(suffix):
        concrete = f"{head}.png"
    before, after, width = _split_at_number(concrete, sensor)
    digits = width or max(_FEWEST_DIGITS, len(str(numbers[-1])))
    if before[-1:].isdigit():  # otherwise frame 0001 of cam2 would be read as frame 20001
        before, digits = f"{before}_", width - 1 if width else digits
    files = SourceFiles(sensor, "images", before, after, digits, pattern=pattern)
    ends = [numbers[0], numbers[-1]] if len(numbers) > 1 else [numbers[0]]
    names = [files.name(number) for number in ends]
    # images that do not end in their number are counted, so that two of them are 0 and 1
    wanted = list(range(len(ends))) if files.counts_from_zero else ends
    read_as = frame_numbers([Path(name) for name in names])
    if not all(_matches(pattern, name) for name in names) or read_as != wanted:
        raise SessionError(
            f"{_where(sensor)}: found {pattern!r}, which leaves no room for the numbers of "
            f'{len(numbers)} frames; use a glob like "{sensor}*.png"'
        )
    _check_format(names[0], sensor)
    return files


def _split_at_number(pattern: str, sensor: str) -> tuple[str, str, int]:
    """Return the text before and after the number, and its digits; 0 for any number of digits."""
    stars = [match for match in _WILD.finditer(pattern) if match.group() == "*"]
    wildcards = stars or list(_SINGLES.finditer(pattern))
    if not wildcards:
        raise SessionError(f'{_where(sensor)}: found {pattern!r}; use a glob like "{sensor}*.png"')
    start, end = wildcards[-1].span()
    digits = 0 if stars else len(_WILD.findall(wildcards[-1].group()))
    return _filled(pattern[:start]), _filled(pattern[end:]), digits


def _filled(pattern: str) -> str:
    """Return the shortest name that matches a glob."""

    def fill(match: re.Match[str]) -> str:
        text = match.group()
        if text in ("*", "**/"):
            return ""
        return next((c for c in "0a_A1-" if fnmatchcase(c, text)), text[1:2])

    return _WILD.sub(fill, pattern)


def _matches(pattern: str, name: str) -> bool:
    if "**/" in pattern:
        pattern, name = pattern.rpartition("**/")[2], PurePosixPath(name).name
    patterns, names = PurePosixPath(pattern).parts, PurePosixPath(name).parts
    return len(patterns) == len(names) and all(map(fnmatchcase, names, patterns))


def _check_format(name: str, sensor: str) -> None:
    suffix = PurePosixPath(name).suffix
    if suffix.casefold() not in IMAGES_WRITTEN:
        raise SessionError(
            f"{_where(sensor)}: found images {suffix or name!r}; simulate writes "
            f"{', '.join(IMAGES_WRITTEN)}"
        )

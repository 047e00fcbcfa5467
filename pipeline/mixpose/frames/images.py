"""Read image files as a source: order and number them, and refuse damaged ones."""

from __future__ import annotations

import io
import logging
import re
import stat
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, cast

import cv2
import numpy as np

from mixpose.errors import RecordingError, reporting
from mixpose.frames.capture import quieten_opencv
from mixpose.frames.source import Frames, Source, SourceKind, SourceSpec, numbers_text
from mixpose.frames.times import Clock
from mixpose.limits import MOST_IMAGE_BYTES, MOST_PIXELS
from mixpose.records import Image, RawFrame

_RASTERS = {".bmp", ".dib", ".pbm", ".pfm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff"}
_PICTURES = {".avif", ".exr", ".hdr", ".jp2", ".jpe", ".jpeg", ".jpg", ".webp"}
IMAGE_SUFFIXES = frozenset(_RASTERS | _PICTURES)

_TOO_LARGE = f"found more pixels than are allowed, {MOST_PIXELS}"

_PNG_START = b"\x89PNG\r\n\x1a\n"
_PIECE = 4096  # bytes; zlib releases the interpreter lock from 5 kB on
_JPEG_START = b"\xff\xd8\xff"
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# nanoseconds since 1970, from 1973 to the limit of an int64 in 2262: no camera counts so far
_FIRST_STAMP, _LAST_STAMP = 10**17, 2**63
_START_OF_SCAN = 0xDA
_END_OF_IMAGE = b"\xff\xd9"


@dataclass(frozen=True)
class ImageSequence(Source):
    """Images of a camera, by ascending frame number."""

    kind: ClassVar[SourceKind] = "images"
    ahead: ClassVar[int] = 3

    paths: tuple[Path, ...]  # at least one
    numbers: tuple[int, ...]  # of the frames, ascending
    resolution: tuple[int, int] | None  # px of all images; None: that of the first one read
    clock: Clock | None  # gives the time of a frame number
    is_stamped: bool = False  # whether the numbers are times in ns, used by the clock
    has_fps: bool = False  # whether the session states a rate

    @property
    def length(self) -> int:
        """Number of images."""
        return len(self.paths)

    @property
    def first(self) -> int:
        """Number of the first image."""
        return self.numbers[0]

    def describe(self) -> str:
        """Describe the source in a line; reads the first image."""
        image = read_image(self.paths[0])
        depth = "" if image.dtype == np.uint8 else f" {image.dtype}"
        plural = "" if self.length == 1 else "s"
        numbers = numbers_text(self.first, self.numbers[-1], self.length)
        return f"{self.length} image{plural} {_size_text(_size(image))}{depth}, {numbers}"

    def caution(self) -> str | None:
        """Describe odd frame numbers: stamps in spite of fps, an unnatural order, or places."""
        if self.is_stamped and self.has_fps:
            return (
                "the names of its images end in times since 1970, which are taken for theirs, and "
                "not fps; drop fps, or name a table of times"
            )
        endings, indices = _end_numbers(self.paths), [*range(self.length)]
        by_name = natural_order(self.paths)
        are_alike = len({re.sub("[0-9]+", "0", str(path)) for path in by_name}) == 1
        if are_alike and endings == [*self.numbers] and [*self.paths] != by_name:
            first = next(k for k, path in enumerate(by_name) if path != self.paths[k])
            return (
                f"{self.paths[first].name} comes before {by_name[first].name}, as frames go by the "
                "last number of a name alone; should they go by others before it, name them anew"
            )
        if self.length < 3 or [*self.numbers] != indices or endings == indices:
            return None
        bare = [path.name for path, value in zip(self.paths, endings, strict=True) if value is None]
        if bare and len(bare) < self.length / 2:
            return (
                f"{bare[0]} ends in no frame number but {self.length - len(bare)} others do, so "
                "all are numbered by their place; leave it out of the source"
            )
        if not bare:
            double = next(v for v in endings if endings.count(v) > 1)
            return (
                f"two names end in the frame number {double}, so all are numbered by their place; "
                "leave one out of the source"
            )
        return None

    def known_numbers(self) -> Sequence[int]:
        """Return the frame numbers, ascending."""
        return self.numbers

    def _frames(self, wanted: range) -> Frames:
        size, like = self.resolution, "the sensor's resolution"
        for number, path in zip(self.numbers, self.paths, strict=True):
            if number not in wanted:
                continue
            image = read_image(path)
            if size is None:
                size, like = _size(image), path.name
            if _size(image) != size:
                raise RecordingError(
                    f"{path}: found {_size_text(_size(image))} pixels, allowed is "
                    f"{_size_text(size)} like {like}"
                )
            yield RawFrame(number, self.clock(number) if self.clock else None, image)


def open_images(spec: SourceSpec, paths: Sequence[Path], clock: Clock | None) -> ImageSequence:
    """Open images as a source, in the order of their `frame_numbers`."""
    numbers, ordered = zip(*sorted(zip(frame_numbers(paths), paths, strict=True)), strict=True)
    is_stamped = spec.times is None and all(_FIRST_STAMP <= n < _LAST_STAMP for n in numbers)
    if is_stamped:  # a quotient of whole numbers is rounded once
        clock = lambda stamp: stamp / 10**9  # noqa: E731
    return ImageSequence(ordered, numbers, spec.resolution, clock, is_stamped, spec.fps is not None)


def frame_numbers(paths: Sequence[Path]) -> list[int]:
    """Return frame numbers: those at the ends of names, if all differ, else places in `paths`."""
    numbers = [number for number in _end_numbers(paths) if number is not None]
    return numbers if len(numbers) == len({*numbers}) == len(paths) else [*range(len(paths))]


def _end_numbers(paths: Sequence[Path]) -> list[int | None]:
    """Return the numbers at the ends of names; nanoseconds if all are seconds since 1970."""
    stamps = [re.search(r"(?<![0-9])(1[0-9]{9})[.]([0-9]{1,9})$", path.stem) for path in paths]
    times = [int(match[1] + match[2].ljust(9, "0")) for match in stamps if match]
    if len(times) == len(paths) > 1 and not _are_counted([match[0] for match in stamps if match]):
        return [*times]
    matches = [re.search(r"[0-9]+$", path.stem) for path in paths]
    return [int(match.group()) if match else None for match in matches]


def _are_counted(stamps: Sequence[str]) -> bool:
    """Test whether stamps as 1234567890.0001 are a constant number and a count of frames."""
    seconds, parts = zip(*(stamp.split(".") for stamp in stamps), strict=True)
    counts = sorted(map(int, parts))
    return len({*seconds}) == 1 and counts[-1] - counts[0] < 2 * len(counts)


def natural_order(paths: Sequence[Path]) -> list[Path]:
    """Sort paths with the numbers inside names by value, so that img9 precedes img10."""

    def key(path: Path) -> tuple[list[str | int], str]:
        pieces = re.split(r"([0-9]+)", str(path.with_suffix("")))
        return [int(p) if i % 2 else p for i, p in enumerate(pieces)], str(path)

    return sorted(paths, key=key)


def read_image(path: Path) -> Image:
    """Read an image file as grey values (H, W) of its depth: uint8, uint16 or float32.

    Raises RecordingError if it cannot be read, is cut short, damaged or no image, or holds NaN.
    """
    quieten_opencv()
    data = _bytes_of(path)
    fault = _fault_of(data)
    if fault is not None:
        raise RecordingError(f"{path}: {fault}; record or copy it again, or leave it out")
    if data.startswith(_TIFF_STARTS) and (count := _pages(data)) > 1:
        raise RecordingError(
            f"{path}: holds {count} images; allowed is one image in a file: split it, with "
            "ImageMagick as: magick frames.tif frame_%04d.png"
        )
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        )
    except cv2.error as error:
        reason = _TOO_LARGE if "PIXELS" in str(error) else f"cannot be decoded: {error.err}"
        raise RecordingError(f"{path}: {reason}") from error
    if image is not None and image.size > MOST_PIXELS:
        raise RecordingError(f"{path}: {_TOO_LARGE}")
    if image is None:
        raise RecordingError(
            f"{path}: no image, damaged or cut short; allowed is what OpenCV reads"
        )
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise RecordingError(
            f"{path}: found pixels of type {image.dtype}, allowed are uint8, uint16 and float32"
        )
    if image.dtype == np.float32 and not np.isfinite(image).all():
        raise RecordingError(f"{path}: found pixels that are not finite, allowed are numbers")
    return cast(Image, image)


def _bytes_of(path: Path) -> bytes:
    """Read a whole file in few system calls, each of which releases the interpreter lock."""
    with reporting(RecordingError, f"{path}: cannot be read"):
        status = path.stat()
        is_file, size = stat.S_ISREG(status.st_mode), status.st_size
        if is_file and size <= MOST_IMAGE_BYTES:
            with path.open("rb", buffering=0) as file:
                data = file.read(size)
                # a call reads it all, unless it is interrupted or the file is cut meanwhile
                return data if len(data) == size else data + file.read()
    text = f"{size} bytes" if is_file else "no file"
    raise RecordingError(f"{path}: found {text}; allowed: a file of at most {MOST_IMAGE_BYTES}")


def _fault_of(data: bytes) -> str | None:
    """Describe a fault in the bytes of an image that a decoder may ignore, or print about."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG_START):
        return _png_fault(data)
    if data.startswith(_JPEG_START) and not _jpeg_is_whole(data):
        return "cut short: the JPEG data have no end"
    return None


def _pages(data: bytes) -> int:
    """Count the images of a TIFF file, without thumbnails; 1 if it is damaged."""
    from tifffile import TiffFile, TiffFileError, logger  # noqa: PLC0415 - slow, for TIFF alone

    logger().setLevel(logging.CRITICAL)  # the decoder says what is wrong
    try:
        with TiffFile(io.BytesIO(data)) as file:
            return len(file.pages) - sum(bool(page.aspage().is_reduced) for page in file.pages)
    except (TiffFileError, ValueError, struct.error, IndexError):
        return 1


def _png_fault(data: bytes) -> str | None:
    """Check the chunks (PNG specification, section 5) up to IEND; what follows is harmless."""
    view = memoryview(data)
    offset = len(_PNG_START)
    while offset + 12 <= len(data):
        kind_at, content_at = offset + 4, offset + 8
        check_at = content_at + int.from_bytes(view[offset:kind_at])
        offset = check_at + 4
        if offset > len(data):
            break
        kind = data[kind_at:content_at]
        critical = not kind[0] & 0x20
        if critical and _checksum(view[kind_at:check_at]) != int.from_bytes(view[check_at:offset]):
            return f"damaged: the checksum of PNG chunk {kind!r} at byte {kind_at - 4} is wrong"
        if kind == b"IEND":
            return None
    return "cut short: the PNG data have no end"


def _checksum(content: memoryview) -> int:
    """Return the CRC-32, in pieces for which zlib keeps the interpreter lock."""
    # to get the lock back from a busy thread takes far longer than a chunk, and there are many
    value = 0
    for start in range(0, len(content), _PIECE):
        value = zlib.crc32(content[start : start + _PIECE], value)
    return value


def _jpeg_is_whole(data: bytes) -> bool:
    """Test whether the end marker follows the first scan."""
    # skip the segments before the scan (ITU T.81, annex B), as a preview image in them has an end
    # marker, too
    offset = 2
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == _START_OF_SCAN:
            return data.rfind(_END_OF_IMAGE, offset) >= 0
        if marker == 0xFF:  # padding
            offset += 1
        else:
            offset += 2 + int.from_bytes(data[offset + 2 : offset + 4])
    return False


def _size(image: Image) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


def _size_text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"

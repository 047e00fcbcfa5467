"""Draw spots into grey images and range profiles, and write them: a writer per kind of source.

A spot is a Gaussian integrated over each pixel or bin, so that its centroid is at the projection of
the feature, without a bias toward pixel centres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.special import erf

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.simulation.naming import SourceFiles
from mixpose.simulation.options import SimulationOptions
from mixpose.simulation.visible_spots import VisibleSpots, coverage

_REACH = 5.0  # standard deviations up to which a spot is drawn: it is below 1e-6 beyond
_WHITE = 255.0
_RED, _GREEN, _BLUE = 1.0, 0.8, 0.6
# Run lengths without a filter: best for noise, and fast.
_PNG = (
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_NONE,
)
_VIDEO_QUALITY = 95


def draw_spots(image: NDArray[np.floating], points: Floats, peaks: Floats, sigma: float) -> None:
    """Add Gaussian spots at centres (M, 2) to an image (H, W), in place.

    Centres are in px, u right and v down, pixel centres at integers; a spot adds ``peak · 2π σ²``
    in total.
    """
    height, width = image.shape
    for (u, v), peak in zip(points, peaks):
        columns = _cells(u, sigma, width)
        rows = _cells(v, sigma, height)
        total = peak * 2 * np.pi * sigma**2
        across = _shares(rows, v, sigma)[:, None] * _shares(columns, u, sigma)
        image[rows.start : rows.stop, columns.start : columns.stop] += total * across


def draw_profile(profile: Floats, places: Floats, peaks: Floats, sigma: float) -> None:
    """Add Gaussian peaks at `places` (M,), in bins, to a profile (B,), in place.

    Bin centres are at integers; a peak adds ``peak · √(2π) σ`` in total.
    """
    for place, peak in zip(places, peaks):
        bins = _cells(place, sigma, len(profile))
        total = peak * np.sqrt(2 * np.pi) * sigma
        profile[bins.start : bins.stop] += total * _shares(bins, place, sigma)


@dataclass(frozen=True)
class ImageFormat:
    """Format of a camera's images."""

    resolution: tuple[int, int]  # width and height, px
    spot_sigma: float  # standard deviation of a spot, px
    polarity: Literal["bright", "dark"] = "bright"  # "dark" is the negative of "bright"


@dataclass(frozen=True)
class ProfileFormat:
    """Format of a range sensor's profiles."""

    bins: int
    range_min: float  # of the first bin
    bin_size: float  # from bin to bin
    width: float  # standard deviation of a feature's peak, length units


def render_image(
    visible: VisibleSpots, form: ImageFormat, options: SimulationOptions, rng: Generator
) -> NDArray[np.uint8]:
    """Draw the image (H, W) that a camera takes of spots in px, clipped at 255."""
    width, height = form.resolution
    image = np.zeros((height, width), dtype=np.float32)
    draw_light(image, visible, options.brightness, form.spot_sigma)
    if options.bayer:
        # share of warm white light that passes the colour filter of each pixel
        gains = np.full(image.shape, _GREEN, np.float32)
        gains[::2, ::2], gains[1::2, 1::2] = _RED, _BLUE
        image *= gains
    if options.shot_noise:
        lit = image > 0
        spread = np.sqrt(options.shot_noise * image[lit])
        image[lit] += spread * rng.standard_normal(spread.size, dtype=np.float32)
    image += np.float32(options.background)
    if options.noise:
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        noise *= np.float32(options.noise)
        image += noise
    np.clip(np.rint(image, out=image), 0, _WHITE, out=image)
    grey = image.astype(np.uint8)
    if options.bayer:
        colours = cv2.cvtColor(grey, cv2.COLOR_BayerRGGB2BGR)
        grey = np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if form.polarity == "dark":
        grey = np.asarray(255 - grey, dtype=np.uint8)
    if options.jpeg is not None:
        packed = cv2.imencode(".jpg", grey, (cv2.IMWRITE_JPEG_QUALITY, int(options.jpeg)))[1]
        grey = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return grey


def draw_light(
    image: NDArray[np.float32], visible: VisibleSpots, brightness: float, sigma: float
) -> None:
    """Add all spots to an image, and darken it where something dark is in front.

    Spots without a size are Gaussians of `sigma`; the others are evenly bright within outlines that
    are blurred by `sigma`.
    """
    outlines = visible.outlines
    is_plain = np.array([k not in outlines for k in range(len(visible))], dtype=np.bool_)
    peaks = brightness * visible.levels
    draw_spots(image, visible.points[is_plain], peaks[is_plain], sigma)
    if outlines:
        disks = np.zeros(image.shape, dtype=np.float32)
        for k, outline in outlines.items():
            rows, columns, shares = coverage(outline, image.shape)
            disks[rows, columns] += np.float32(peaks[k]) * shares.astype(np.float32)
        image += cv2.GaussianBlur(disks, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    for occluder in visible.occluders:
        rows, columns, shares = coverage(occluder, image.shape)
        image[rows, columns] *= (1 - shares).astype(np.float32)


def render_profile(
    visible: VisibleSpots, form: ProfileFormat, options: SimulationOptions, rng: Generator
) -> NDArray[np.float32]:
    """Draw the profile (bins,) of spots in length units: 1 at a mean feature, never below 0."""
    profile = np.zeros(form.bins)
    places = (visible.points[:, 0] - form.range_min) / form.bin_size
    draw_profile(profile, places, visible.levels, form.width / form.bin_size)
    profile += rng.standard_normal(form.bins) / options.range_snr
    return np.maximum(profile, 0.0).astype(np.float32)


def _cells(centre: float, sigma: float, count: int) -> range:
    """Return the cells within reach of a spot."""
    reach = ceil(_REACH * sigma) + 1
    middle = round(centre)
    return range(min(max(middle - reach, 0), count), max(min(middle + reach + 1, count), 0))


def _shares(cells: range, centre: float, sigma: float) -> Floats:
    """Return the share of a unit Gaussian in each cell."""
    edges = np.arange(cells.start, cells.stop + 1) - 0.5
    return np.asarray(np.diff(0.5 * erf((edges - centre) / (np.sqrt(2) * sigma))))


def _with_folder(path: Path) -> Path:
    """Return a path after making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


Write: TypeAlias = Callable[[int, float, VisibleSpots, Generator], None]
"""Function that writes a sensor's frame, by its number, time in s, spots and random numbers.

Numbers ascend.
"""


@contextmanager
def image_writer(
    files: SourceFiles, options: SimulationOptions, form: ImageFormat, folder: Path
) -> Iterator[Write]:
    """Write a file per image."""

    def write(number: int, time_s: float, visible: VisibleSpots, rng: Generator) -> None:
        image = render_image(visible, form, options, rng)
        path = _with_folder(folder / files.name(number))
        suffix = path.suffix.casefold()
        path.write_bytes(cv2.imencode(suffix, image, _PNG if suffix == ".png" else ())[1].tobytes())

    yield write


@contextmanager
def video_writer(
    files: SourceFiles, options: SimulationOptions, form: ImageFormat, fps: float, folder: Path
) -> Iterator[Write]:
    """Write all images into one video: MJPEG in .avi, MPEG-4 in .mp4."""
    path = _with_folder(folder / files.path)
    # the quality of OpenCV's own MJPEG writer can be set
    is_mjpeg = path.suffix.casefold() == ".avi"
    video = cv2.VideoWriter(
        str(path),
        cv2.CAP_OPENCV_MJPEG if is_mjpeg else cv2.CAP_FFMPEG,
        cv2.VideoWriter.fourcc(*("MJPG" if is_mjpeg else "mp4v")),
        fps,
        form.resolution,
        (cv2.VIDEOWRITER_PROP_QUALITY, _VIDEO_QUALITY) if is_mjpeg else (),
    )
    if not video.isOpened():
        raise SessionError(
            f"simulate: sensor {files.sensor!r}: source: {files.path} cannot be written as a "
            'video; write images, with a glob like "left*.png"'
        )

    def write(number: int, time_s: float, visible: VisibleSpots, rng: Generator) -> None:
        image = render_image(visible, form, options, rng)
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))

    try:
        yield write
    finally:
        video.release()


@contextmanager
def profile_writer(
    files: SourceFiles, options: SimulationOptions, form: ProfileFormat, folder: Path
) -> Iterator[Write]:
    """Write a row per frame: .npy of float32, or .csv without a header."""
    path = _with_folder(folder / files.path)
    is_text = path.suffix.casefold() == ".csv"
    with path.open("wb") as file:
        if not is_text:
            shape = (options.frames, form.bins)
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)

        def write(number: int, time_s: float, visible: VisibleSpots, rng: Generator) -> None:
            profile = render_profile(visible, form, options, rng)
            row = profile.astype("<f4").tobytes()
            if is_text:
                row = (",".join(f"{value:.6g}" for value in profile.tolist()) + "\n").encode(
                    "ascii"
                )
            file.write(row)

        yield write


@contextmanager
def detection_writer(
    files: SourceFiles, noise: float, coordinates: tuple[str, ...], folder: Path
) -> Iterator[Write]:
    """Write a row per detection, shuffled, or one of weight 0 for a frame without any."""
    path = _with_folder(folder / files.path)
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join(("frame", "time_s", *coordinates, "weight")) + "\n")

        def write(number: int, time_s: float, visible: VisibleSpots, rng: Generator) -> None:
            errors = noise * rng.standard_normal(visible.points.shape)
            is_shown = np.ones(len(errors), dtype=bool)
            for occluder in visible.occluders:
                corners = occluder.astype(np.float32)
                inside = [cv2.pointPolygonTest(corners, y.tolist(), False) for y in visible.points]
                is_shown &= np.array(inside, dtype=float) < 0
            points, weights = (visible.points + errors)[is_shown], visible.levels[is_shown]
            if not len(points):
                points, weights = np.zeros((1, len(coordinates))), np.zeros(1)
            for i in rng.permutation(len(points)):
                cells = ",".join(f"{value:.9g}" for value in (*points[i], weights[i]))
                file.write(f"{number},{time_s:.6f},{cells}\n")

        yield write

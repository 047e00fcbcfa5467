"""Measure what is above a threshold, and find thresholds that give more or fewer blobs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.extraction.blobs import extract_blobs
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.threshold import Foreground, above, foreground
from mixpose.pictures.finding import Expectation, Finding
from mixpose.records import Floats, Image, Mask

NEAR_SIGMAS = 3.0  # half-width of the box around a predicted place, in σ
FLOODED = 0.02  # share of an image above the threshold from which on too much is feature
_REVERSED = 0.5  # share from which on the background counts as feature
_AS_LARGE = 3.0  # times the usual area: at most that large is a marker by itself
_LOWER = (0.8, 0.6, 0.45, 0.3)  # tried heights above the background, by that of the threshold
_LISTED = 6  # features that are named one by one


@dataclass(frozen=True)
class Light:
    """An image with the threshold by which blobs or grey values are extracted from it."""

    image: Image
    options: ExtractOptions

    @cached_property
    def scene(self) -> Foreground:
        """Grey values without the background, and the threshold."""
        height, width = self.image.shape
        return foreground(self.image, self.options, (0, 0, width, height))

    @cached_property
    def above(self) -> NDArray[np.uint8]:
        """Mask of the pixels above the threshold: 1, else 0."""
        return above(self.scene.grey, self.scene.zero + self.scene.level)

    @property
    def share(self) -> float:
        """Share of the pixels above the threshold."""
        return float(np.mean(self.above))

    @cached_property
    def raw(self) -> Floats:
        """Grey values with features bright."""
        return np.asarray(self.in_image(self.image.astype(np.float64)))

    def in_image(self, level: Any) -> Any:
        """Convert a grey level of `raw` to one of the image, as in the session file, or back."""
        if self.options.polarity == "bright":
            return level
        if self.image.dtype == np.float32:
            return float(self.image.max()) - level
        return (255.0 if self.image.dtype == np.uint8 else 65535.0) - level

    def formatted(self, level: float) -> str:
        """Format a grey level for a session file; for floats to three digits of their range."""
        digits, span = 0, float(np.ptp(self.image))
        if self.image.dtype == np.float32 and span > 0:
            digits = max(2 - math.floor(math.log10(span)), 0)
        return f"{level:.{digits}f}"

    @cached_property
    def level(self) -> float:
        """Threshold as a grey level of the image."""
        # `scene.grey` is without its varying background; the median represents it
        base = float(np.median(self.raw)) if self.scene.is_selective else 0.0
        return float(self.in_image(base + self.scene.level))

    @cached_property
    def pieces(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Connected pieces above the threshold: labels of pixels, 0 for none, and their areas."""
        return _pieces(self.above)


def _pieces(mask: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the labels of the connected pieces of a mask, 0 for none, and their areas."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask)
    areas = np.asarray(statistics[:, cv2.CC_STAT_AREA], dtype=np.int32)
    areas[0] = 0
    return np.asarray(labels, dtype=np.int32), areas


def change_of(options: ExtractOptions, *, lower: bool, level: str = "") -> str:
    """Advise how to change a threshold; `level` is the one that a rule chose, if known."""
    down = lower == (options.polarity == "bright" or options.method in ("corners", "log"))
    now = options.threshold
    if isinstance(now, str):
        side = "below" if down else "above"
        if not level:
            return f'set threshold to a number {side} that of "{now}"'
        return f'set threshold to a grey level {side} {level}, that of "{now}"'
    return f"{'lower' if down else 'raise'} threshold = {now:g}"


def lower_level(light: Light, level: float) -> str:
    """Advise a threshold at a level of `raw`, or "local" if too much of the image is above it."""
    if float(np.mean(light.raw > level)) > FLOODED:
        return 'set threshold = "local", as the background is as bright elsewhere'
    direction = "lower" if light.options.polarity == "bright" else "raise"
    return f"{direction} it: threshold = {light.formatted(light.in_image(level))}"


def threshold_for_more(light: Light, expected: int) -> str:
    """Advise a lower threshold that gives about as many blobs as expected, if there is one."""
    options, base = light.options, float(np.median(light.raw))
    if not isinstance(options.threshold, str):
        return change_of(options, lower=light.share < _REVERSED)
    height = float(light.scene.level)
    counts = {}
    for level in (base + share * height for share in _LOWER):
        _, areas = _pieces((light.raw > level).astype(np.uint8))
        counts[level] = int(np.count_nonzero(areas[1:] >= options.min_area))
    likely = [level for level, n in counts.items() if 0.8 * expected <= n <= 3 * expected]
    for level in sorted(likely, reverse=True):
        number = light.formatted(light.in_image(level))
        count = len(_blobs_at(light, float(number)))
        if 0.8 * expected <= count <= 3 * expected:
            return f"threshold = {number} finds {count} in this frame"
    return "no lower threshold finds them: hidden, out of light, or out of view?"


def threshold_apart(
    finding: Finding, expected: Expectation, light: Light, body: Body, features: Sequence[int]
) -> str:
    """Advise a threshold that parts features from their surroundings, if there is one."""
    options, met = light.options, np.flatnonzero(expected.seen & expected.met)
    if not isinstance(options.threshold, str):
        return change_of(options, lower=False)
    labels, areas = light.pieces
    boxes = {
        i: around(expected.y[i], NEAR_SIGMAS * finding.sigma, light.raw.shape)
        for i in [*met.tolist(), *features]
    }
    largest = {i: int(labels[box].flat[areas[labels[box]].argmax()]) for i, box in boxes.items()}
    peak = min([float(light.raw[boxes[i]].max()) for i in met.tolist()], default=np.inf)
    usual = float(np.median([areas[largest[i]] for i in met.tolist()] or [np.inf]))
    ground = np.median(light.raw[np.isin(labels, [largest[i] for i in features])])
    level = (peak + float(ground)) / 2
    pieces, sizes = _pieces((light.raw > level).astype(np.uint8))
    parted_sizes = {i: int(sizes[pieces[boxes[i]]].max()) for i in features}
    parted = [i for i in features if options.min_area <= parted_sizes[i] <= _AS_LARGE * usual]
    if not parted:
        return "no threshold parts them"
    number = light.formatted(light.in_image(level))
    reach, y = NEAR_SIGMAS * finding.sigma, expected.y[expected.seen]
    before, after = _blobs_at(light, options.threshold), _blobs_at(light, float(number))
    parted = [i for i in parted if _near(expected.y[[i]], after, reach).all()]
    # in uneven light, clutter elsewhere may be above that level
    has_more_clutter = (~_near(after, y, reach)).sum() > (~_near(before, y, reach)).sum()
    if not parted or has_more_clutter or not _near(expected.y[met], after, reach).all():
        return "no threshold parts them"
    which = names_of(parted, body) if len(parted) < len(features) else "them"
    return f"threshold = {number} parts {which} in this frame"


def threshold_without(finding: Finding, extra: Floats, light: Light, level: float) -> str:
    """Advise a threshold without the blobs at places `extra` (n, 2), but with all others.

    Returns "" if the level does not achieve that, as in uneven light.
    """
    number, reach = light.formatted(light.in_image(level)), max(finding.sigma, 1.0)
    before, after = _blobs_at(light, light.options.threshold), _blobs_at(light, float(number))
    remaining = before[~_near(before, extra, reach)]
    fits = len(after) == len(remaining) and _near(remaining, after, reach).all()
    return f"threshold = {number}" if fits else ""


def _blobs_at(light: Light, threshold: str | float) -> Floats:
    """Extract the places (n, 2) of blobs of the image at a threshold."""
    height, width = light.image.shape
    options = replace(light.options, threshold=threshold)
    return extract_blobs(light.image, options, (0, 0, width, height)).points


def _near(places: Floats, others: Floats, reach: float) -> Mask:
    """Return a mask of the places (n, 2) that are within a reach of any others (k, 2)."""
    away = np.linalg.norm(places[:, None] - others, axis=-1)
    return np.asarray(away.min(axis=1, initial=np.inf) <= reach)


def around(place: Floats, radius: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return rows and columns of a box around a place, clipped to an image of a shape."""
    u, v = (int(np.clip(round(x), 0, n - 1)) for x, n in zip(place, shape[::-1], strict=True))
    r = max(round(radius), 1)
    return slice(max(v - r, 0), v + r + 1), slice(max(u - r, 0), u + r + 1)


def names_of(features: Iterable[int], body: Body) -> str:
    """List features by name, at most six, for a message."""
    features = list(features)
    shown = ", ".join(body.labels[i] for i in features[:_LISTED])
    others = len(features) - _LISTED
    return f"feature{'s' * (len(features) != 1)} {shown}" + (f" and {others} more" * (others > 0))

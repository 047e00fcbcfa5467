"""Grey levels: what is above a threshold, and which would find more features or fewer."""

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

NEAR_SIGMAS = 3.0  # how far around a predicted place its light is looked for
FLOODED = 0.02  # share of an image above a threshold that would find everything
_REVERSED = 0.5  # share from which it is the background that counts as feature
_AS_LARGE = 3.0  # times the usual area: a marker by itself, and no part of something else
_LOWER = (0.8, 0.6, 0.45, 0.3)  # of the height of a threshold above the background
_LISTED = 6  # features that are named one by one


@dataclass(frozen=True)
class Light:
    """An image as blobs and grey values are extracted from it: what is above the threshold."""

    image: Image
    options: ExtractOptions

    @cached_property
    def scene(self) -> Foreground:
        """Its grey values without the background, and the threshold."""
        height, width = self.image.shape
        return foreground(self.image, self.options, (0, 0, width, height))

    @cached_property
    def above(self) -> NDArray[np.uint8]:
        """1 where it is above the threshold, else 0."""
        return above(self.scene.grey, self.scene.zero + self.scene.level)

    @property
    def share(self) -> float:
        """Of the pixels above the threshold."""
        return float(np.mean(self.above))

    @cached_property
    def raw(self) -> Floats:
        """Grey values with features bright."""
        return np.asarray(self.in_image(self.image.astype(np.float64)))

    def in_image(self, level: Any) -> Any:
        """A grey level of `raw` as the session file wants it, and the reverse."""
        if self.options.polarity == "bright":
            return level
        if self.image.dtype == np.float32:
            return float(self.image.max()) - level
        return (255.0 if self.image.dtype == np.uint8 else 65535.0) - level

    def written(self, level: float) -> str:
        """A grey level as a session file has it; of floats, to three digits of their range."""
        digits, span = 0, float(np.ptp(self.image))
        if self.image.dtype == np.float32 and span > 0:
            digits = max(2 - math.floor(math.log10(span)), 0)
        return f"{level:.{digits}f}"

    @cached_property
    def level(self) -> float:
        """The grey level in the image above which, or below, something is a feature."""
        # a background that varies is out of `scene.grey`; its middle stands for it
        base = float(np.median(self.raw)) if self.scene.is_selective else 0.0
        return float(self.in_image(base + self.scene.level))

    @cached_property
    def pieces(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Connected pieces above the threshold: a label per pixel, and areas; 0 is none."""
        _, labels, statistics, _ = cv2.connectedComponentsWithStats(self.above)
        areas = np.asarray(statistics[:, cv2.CC_STAT_AREA], dtype=np.int32)
        areas[0] = 0
        return np.asarray(labels, dtype=np.int32), areas


def direction(options: ExtractOptions, *, lower: bool, level: str = "") -> str:
    """How to move a threshold, for dark features the other way; `level` is what a rule chose."""
    down = lower == (options.polarity == "bright" or options.method in ("corners", "log"))
    now = options.threshold
    if isinstance(now, str):
        side = "below" if down else "above"
        if not level:
            return f'set threshold to a number {side} that of "{now}"'
        return f'set threshold to a grey level {side} {level}, that of "{now}"'
    return f"{'lower' if down else 'raise'} threshold = {now:g}"


def looser(light: Light, level: float) -> str:
    """A level of the image that is lower than that of a rule, unless all would be above it."""
    if float(np.mean(light.raw > level)) > FLOODED:
        return 'set threshold = "local", as the background is as bright elsewhere'
    direction = "lower" if light.options.polarity == "bright" else "raise"
    return f"{direction} it: threshold = {light.written(light.in_image(level))}"


def more(light: Light, expected: int) -> str:
    """A threshold at which pieces are as many as expected, or nearly so, where there is one."""
    options, base = light.options, float(np.median(light.raw))
    if not isinstance(options.threshold, str):
        return direction(options, lower=light.share < _REVERSED)
    over = float(light.scene.level)
    counts = {}
    for level in (base + share * over for share in _LOWER):
        statistics = cv2.connectedComponentsWithStats((light.raw > level).astype(np.uint8))[2]
        counts[level] = int(np.count_nonzero(statistics[1:, cv2.CC_STAT_AREA] >= options.min_area))
    likely = [level for level, n in counts.items() if 0.8 * expected <= n <= 3 * expected]
    for level in sorted(likely, reverse=True):
        number = light.written(light.in_image(level))
        found = len(_found_at(light, float(number)))
        if 0.8 * expected <= found <= 3 * expected:
            return f"threshold = {number} finds {found} in this frame"
    return "no lower threshold finds them: hidden, out of light, or out of view?"


def apart(
    finding: Finding, expected: Expectation, light: Light, body: Body, features: Sequence[int]
) -> str:
    """The threshold at which features stand apart from what is about them, where there is one."""
    options, met = light.options, np.flatnonzero(expected.seen & expected.met)
    if not isinstance(options.threshold, str):
        return direction(options, lower=False)
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
    _, pieces, there, _ = cv2.connectedComponentsWithStats((light.raw > level).astype(np.uint8))
    sizes = np.append(0, there[1:, cv2.CC_STAT_AREA])
    own = {i: int(sizes[pieces[boxes[i]]].max()) for i in features}
    parted = [i for i in features if options.min_area <= own[i] <= _AS_LARGE * usual]
    if not parted:
        return "no threshold parts them"
    number = light.written(light.in_image(level))
    reach, y = NEAR_SIGMAS * finding.sigma, expected.y[expected.seen]
    before, after = _found_at(light, options.threshold), _found_at(light, float(number))
    parted = [i for i in parted if _near(expected.y[[i]], after, reach).all()]
    # where the light is uneven, other things may be above that level
    more = (~_near(after, y, reach)).sum() > (~_near(before, y, reach)).sum()
    if not parted or more or not _near(expected.y[met], after, reach).all():
        return "no threshold parts them"
    which = some(parted, body) if len(parted) < len(features) else "them"
    return f"threshold = {number} parts {which} in this frame"


def leaving_out(finding: Finding, extra: Floats, light: Light, level: float) -> str:
    """A threshold at which things (n, 2) that belong to no feature are not found, and all else is.

    Empty where the level is none, as where the light is uneven.
    """
    number, reach = light.written(light.in_image(level)), max(finding.sigma, 1.0)
    before, after = _found_at(light, light.options.threshold), _found_at(light, float(number))
    rest = before[~_near(before, extra, reach)]
    fits = len(after) == len(rest) and _near(rest, after, reach).all()
    return f"threshold = {number}" if fits else ""


def _found_at(light: Light, threshold: str | float) -> Floats:
    """Places (n, 2) of the blobs of the image at a threshold."""
    height, width = light.image.shape
    options = replace(light.options, threshold=threshold)
    return extract_blobs(light.image, options, (0, 0, width, height)).points


def _near(places: Floats, others: Floats, reach: float) -> Mask:
    """Which of places (n, 2) are within a reach of any of the others (k, 2)."""
    away = np.linalg.norm(places[:, None] - others, axis=-1)
    return np.asarray(away.min(axis=1, initial=np.inf) <= reach)


def around(place: Floats, radius: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """A box about a place in view, at least one pixel."""
    u, v = (int(np.clip(round(x), 0, n - 1)) for x, n in zip(place, shape[::-1], strict=True))
    r = max(round(radius), 1)
    return slice(max(v - r, 0), v + r + 1), slice(max(u - r, 0), u + r + 1)


def some(features: Iterable[int], body: Body) -> str:
    """What features are called, for people."""
    features = list(features)
    shown = ", ".join(body.labels[i] for i in features[:_LISTED])
    more = len(features) - _LISTED
    return f"feature{'s' * (len(features) != 1)} {shown}" + (f" and {more} more" * (more > 0))

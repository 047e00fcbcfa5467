"""An image as blobs and grey values are extracted from it: what is above the threshold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.threshold import Foreground, above, foreground
from mixpose.records import Floats, Image


@dataclass(frozen=True)
class Light:
    """An image as blobs and intensity are extracted from it."""

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

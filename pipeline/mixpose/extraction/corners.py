"""Extract corners where two bright and two dark fields meet, as on a chessboard.

They are saddles of the grey values, where the Hessian of the blurred image has a negative
determinant, located at the stationary point of a quadratic through the pixels around.  (In tests
with noise and blur that came 1.4 to 2 times closer to the truth than `cv2.cornerSubPix`, and 1.7
times closer than `skimage.feature.corner_subpix`, 0.046 to 0.080 px.)  Two rings of samples around
a corner must cross from bright to dark four times and look the same after half a turn, which
excludes saddles by chance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.background import Grey, noise_of
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.quadratic import points_in, stationary_points
from mixpose.extraction.sampling import sample
from mixpose.extraction.threshold import Window
from mixpose.records import Floats, Image, PointPattern

BAND_ROWS = 48
RING_SAMPLES = 32
# Candidates that are fitted together.
BATCH = 256


@dataclass(frozen=True)
class CornerRules:
    """Which saddles are corners."""

    blur: float = constant(
        1.5, "px of blur before the Hessian: enough against noise, and little for fields of 8 px"
    )
    spacing: int = constant(3, "px: least distance of two corners")
    ring_radii: tuple[float, ...] = constant(
        (3.0, 5.0), "px, radii of the rings that must cross four fields: within fields of 8 px"
    )
    symmetry: float = constant(0.9, "of a ring, that must stay the same after half a turn")
    margin: int = constant(6, "px to the border: room for rings and quadratics")
    noise_factor: float = constant(
        2.5,
        "times the noise that a corner's step must have: saddles of noise have 0.3 at this blur, "
        "seldom five times that",
    )
    faint: float = constant(0.2, "of the clearest corner's step, which corners need with `auto`")


CORNERS = CornerRules()


def extract_corners(image: Image, options: ExtractOptions, window: Window) -> PointPattern:
    """Return the saddle points of grey values in a window of an image, as `points_in` does.

    The threshold of the options is "auto", or the least difference of grey values between bright
    and dark fields; corners have neither polarity nor area.
    """
    find = partial(_find, threshold=options.threshold)
    return points_in(image, window, CORNERS.margin, find)


def _find(image: Image, threshold: str | float) -> Floats:
    grey = image.astype(np.float32)
    blurred = cv2.GaussianBlur(grey, (0, 0), CORNERS.blur, borderType=cv2.BORDER_REPLICATE)
    # Rings are thin and sampled with little blur only; single pixels would be noisy.
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0, borderType=cv2.BORDER_REPLICATE)
    starts, steps = _peaks(blurred)
    order = np.argsort(-steps, kind="stable")
    order = order[steps[order] > CORNERS.noise_factor * noise_of(grey)]
    corners, clearest = [np.empty((0, 2))], 0.0
    for first in range(0, len(order), BATCH):
        # Beginning with the clearest, those that are too faint beside them need no fit.
        batch = order[first : first + BATCH]
        batch = batch[steps[batch] >= CORNERS.faint * clearest]
        fitted, is_fitted = stationary_points(
            blurred, starts[batch], lambda uu, uv, vv: 4 * uu * vv - uv * uv < 0
        )
        is_corner, differences = _four_fields(smooth, fitted)
        if isinstance(threshold, str):
            steps_of_corners = steps[batch][is_fitted][is_corner]
            clearest = max(clearest, steps_of_corners.max(initial=0.0))
            corners.append(fitted[is_corner][steps_of_corners >= CORNERS.faint * clearest])
        else:
            corners.append(fitted[is_corner & (differences >= threshold)])
    return np.concatenate(corners)


def saddle_strength(blurred: Grey) -> Grey:
    """Return minus the determinant of the Hessian (H, W), float32: positive at saddles."""
    d_uu = cv2.Sobel(blurred, -1, 2, 0, ksize=3, scale=0.25)
    d_vv = cv2.Sobel(blurred, -1, 0, 2, ksize=3, scale=0.25)
    d_uv = cv2.Sobel(blurred, -1, 1, 1, ksize=3, scale=0.25)
    return np.asarray(cv2.subtract(cv2.multiply(d_uv, d_uv), cv2.multiply(d_uu, d_vv)))


def _peaks(blurred: Grey) -> tuple[Floats, Floats]:
    """Return pixels (n, 2) of local maxima of saddles, away from the border, and steps (n,).

    A step is the difference of grey values between the fields of a sharp corner that makes such a
    saddle.  The work is done in bands of rows, which stay in the cache: 1.9 ms for 640 x 512 px,
    where `skimage.feature.peak_local_max` finds the same in 130 ms.
    """
    margin, spacing = CORNERS.margin, CORNERS.spacing
    box = np.ones((2 * spacing + 1, 2 * spacing + 1), np.uint8)
    height, width = blurred.shape
    columns = np.s_[margin : width - margin]
    places, strengths = [], []
    for top in range(margin, height - margin, BAND_ROWS):
        bottom = min(top + BAND_ROWS, height - margin)
        # Derivatives and maxima need rows on either side.
        first = top - spacing - 1
        strength = saddle_strength(blurred[first : bottom + spacing + 1])
        rows = np.s_[top - first : bottom - first]
        highest = cv2.dilate(strength, box)[rows, columns]
        strength = strength[rows, columns]
        v, u = np.nonzero((strength == highest) & (strength > 0))
        places.append(np.stack([u + margin, v + top], axis=-1))
        strengths.append(strength[v, u])
    # Between fields of grey ±c/2 the mixed second derivative at the corner is c / (π σ²).
    steps = math.pi * CORNERS.blur**2 * np.sqrt(np.concatenate(strengths).astype(np.float64))
    return np.concatenate(places).astype(np.float64), steps


def _four_fields(smooth: Grey, corners: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Test whether four fields meet at corners (n, 2); return that and the step between them."""
    angles = np.arange(RING_SAMPLES) * (2 * np.pi / RING_SAMPLES)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    is_corner = np.ones(len(corners), dtype=np.bool_)
    difference = np.zeros(len(corners))
    for radius in CORNERS.ring_radii:
        samples = sample(smooth, corners[:, None] + radius * ring)
        low, high = samples.min(axis=1, initial=np.inf), samples.max(axis=1, initial=-np.inf)
        bright = samples > ((low + high) / 2)[:, None]
        crossings = np.count_nonzero(bright != np.roll(bright, 1, axis=1), axis=1)
        deviations = samples - samples.mean(axis=1, keepdims=True)
        sums = deviations + np.roll(deviations, RING_SAMPLES // 2, axis=1)
        symmetry = (sums**2).sum(axis=1) / np.maximum(4 * (deviations**2).sum(axis=1), 1e-12)
        is_corner &= (crossings == 4) & (symmetry >= CORNERS.symmetry)
        difference = high - low
    return is_corner, difference

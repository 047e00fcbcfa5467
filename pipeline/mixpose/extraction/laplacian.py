"""Extract unsharp or faint spots by the Laplacian of Gaussian at one width.

A wide and faint spot has no pixel that stands out from the noise, but their sum, which the filter
takes, does (Lindeberg, International Journal of Computer Vision 30, 1998).  A filter of the same
width responds with p / 2 to a Gaussian spot of width s and height p, and with n / (√(2π) s) to
noise of standard deviation n: a spot as high as the noise and 6 px wide has 7.5 times the response
of noise.

Spots are located at stationary points of quadratics through the response.  In tests with spots 3
to 10 px wide they come as close to the truth as noise allows (0.02 px at 75 times the noise, 0.19
px at six times); `skimage.feature.blob_log` gives whole pixels (0.4 px) in three times the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.background import Grey, noise_of
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.quadratic import points_in, stationary_points
from mixpose.extraction.threshold import Window
from mixpose.records import Floats, Image, PointPattern


@dataclass(frozen=True)
class LaplacianRules:
    """Which maxima of the filter are spots."""

    width: float = constant(
        3.0,
        "px, width of spots where the session gives none: a filter finds those of 0.7 to 1.5 times "
        "its width; the response to a width s is lower by 4 s² σ² / (s² + σ²)²",
    )
    noise_factor: float = constant(
        6.0, "times the response's noise: exceeded less than once in a hundred frames of 2 Mpx"
    )
    faint: float = constant(0.2, "of the clearest spot's height, which spots need with `auto`")
    margin: float = constant(2.0, "widths to the border, which cuts nearer spots")
    step: float = constant(1 / 3, "of the width, between samples of the quadratic")
    oblong: float = constant(
        5.0, "largest ratio of a spot's curvatures: along an edge there is hardly any"
    )


LOG = LaplacianRules()


def extract_log(image: Image, options: ExtractOptions, window: Window) -> PointPattern:
    """Return the centres of unsharp or faint spots in a window of an image, as `points_in` does.

    Of the options, `spot_sigma` is the width of the spots in px, 0 for 3 px; `threshold` is "auto"
    or the least height of a spot above its surroundings, in grey values.  Areas are not used.
    """
    width = options.spot_sigma or LOG.width
    margin = math.ceil(LOG.margin * width)
    return points_in(image, window, margin, lambda part: _find(part, options, width, margin))


def spot_strength(image: Image, options: ExtractOptions) -> Grey:
    """Return the height (H, W), in grey values, of a Gaussian spot at each pixel.

    It is the height that gives the filter's response; spots of the given polarity are positive.
    """
    width = options.spot_sigma or LOG.width
    grey = image.astype(np.float32)
    blurred = cv2.GaussianBlur(grey, (0, 0), width, borderType=cv2.BORDER_REFLECT)
    response = cv2.Laplacian(blurred, cv2.CV_32F, ksize=1, borderType=cv2.BORDER_REFLECT)
    sign = -1 if options.polarity == "bright" else 1
    return np.asarray(response * np.float32(sign * 2 * width**2))


def _find(image: Image, options: ExtractOptions, width: float, margin: int) -> Floats:
    from skimage.feature import peak_local_max  # noqa: PLC0415 (0.04 s to import)

    strength = spot_strength(image, options)
    min_height = LOG.noise_factor * 2 * noise_of(image) / (math.sqrt(2 * math.pi) * width)
    if not isinstance(options.threshold, str):
        min_height = max(min_height, options.threshold)
    # A comparison with `cv2.dilate` takes a fifth of the time (7 to 32 ms of 1600 x 1200 px), but
    # finds spots twice if two pixels are equally high: 13 of 200 at a width of 15 px.
    places = peak_local_max(
        strength, min_distance=max(round(width), 1), threshold_abs=min_height, exclude_border=margin
    )
    if isinstance(options.threshold, str):
        heights = strength[places[:, 0], places[:, 1]]
        places = places[heights >= LOG.faint * heights.max(initial=0)]
    starts = places[:, ::-1].astype(np.float64)
    return stationary_points(strength, starts, _is_round, max(LOG.step * width, 1.0))[0]


def _is_round(uu: Floats, uv: Floats, vv: Floats) -> NDArray[np.bool_]:
    """Test whether a quadratic has a maximum that is no ridge."""
    trace, determinant = uu + vv, uu * vv - uv * uv / 4
    return (trace < 0) & (trace**2 < (LOG.oblong + 1) ** 2 / LOG.oblong * determinant)

"""The densities of one camera as a frame was estimated with them: g and C, blur by blur.

g is the observed density g0 ∗ ε, and C is g blurred once more, which the matched objective looks
up.  Objectives that draw samples look g up on a grid around them.  Panels of one kind have one
scale, which a bar below states: it is logarithmic, as a peak falls with the square of the blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.fit import EstimatorOptions
from mixpose.objective import View, matched_objective
from mixpose.objective.paper import sampled_terms
from mixpose.pictures.canvas import WHITE, Picture, in_grid, line_height, stacked, words
from mixpose.pictures.overlay import Part
from mixpose.pictures.stages import fitted, shown_box, titled
from mixpose.records import Floats

Size: TypeAlias = tuple[int, int]

_STEPS_PER_SIGMA = 1.5  # places at which a density is looked up
_SHOWN = 1e-3  # of the lowest peak: what is less is black
_BAR_LINES = 1.6  # height of a bar, lines of captions
_MARGIN = 4  # widest blurs around the body


@dataclass(frozen=True)
class Panel:
    """A density on a picture."""

    title: str
    values: Floats  # (H, W) in 1/px², of each pixel the largest


def densities_picture(
    view: View,
    body: Body,
    T: Floats | None,
    sigmas: Sequence[float],
    options: EstimatorOptions,
    room: Size,
) -> Picture:
    """A row of g at the blurs of a fit, a row of C, and the scale of each below it.

    `sigmas` are standard deviations of a feature in px, in the order of the fit, the last σ_ε or
    less. What there is about the pose is shown, in panels of a size `room`; without a pose, what is
    about all that was found.
    """
    box = shown_box(view, body, T, _MARGIN * max(sigmas))
    part = fitted(box, room)
    rows = []
    for panels in panels_of(view, body, T, sigmas, options, part, room):
        peaks = [float(one.values.max()) for one in panels]
        top = max(peaks) or 1.0  # where nothing was found about the body, all is black
        bottom = _SHOWN * min((peak for peak in peaks if peak > 0), default=top)
        drawn = [titled(_coloured(one.values, bottom, top), one.title) for one in panels]
        row = in_grid(drawn, len(drawn))
        rows += [row, _bar(row.shape[1], drawn[0], bottom, top)]
    return stacked(rows)


def panels_of(
    view: View,
    body: Body,
    T: Floats | None,
    sigmas: Sequence[float],
    options: EstimatorOptions,
    part: Part,
    size: Size,
) -> list[list[Panel]]:
    """The panels of g and those of C, on a picture (width, height) of a part of the image.

    The sampled objectives climb g alone; C is then that at σ_ε, by which the pose is judged.
    """
    is_matched = options.objective == "matched"
    judged = list(sigmas) if is_matched else [view.observation.sigma]
    lower = np.array(part.corner) - 1.0
    shown = lower, lower + np.array(size) / part.zoom + 2.0
    values: NDArray[Any]
    observed, twice = [], []
    for sigma in sigmas:
        places = _places(sigma, part, size)
        if is_matched or T is None:
            # exact sums on a grid
            word, values = "g", view.observation.density(sigma, shown).sample(places)
        else:
            # as the objectives that draw samples have it: around these, and 0 elsewhere
            samples = body.sample(options.samples, seed=options.seed)
            terms = sampled_terms([view], samples, [sigma], T)
            word, values = "g sampled", np.zeros(places.shape[:-1])
            if terms:
                values = terms[0].density.sample(places)[..., 0]
        observed.append(Panel(f"{word}, σ = {sigma:.3g} px", _largest(values, size)))
    for sigma in judged:
        atlas = matched_objective([view], body, [sigma]).atlas
        values = atlas.look_up(_places(sigma, part, size)[None])[0, ..., 0]
        twice.append(Panel(f"C = g ∗ ε, σ = {sigma:.3g} px", _largest(values, size)))
    return [observed, twice]


def _places(sigma: float, part: Part, size: Size) -> Floats:
    """Places (fine H, fine W, 2) of a picture at which a density is looked up."""
    fine = max(int(np.ceil(_STEPS_PER_SIGMA / (part.zoom * sigma))), 1)
    u, v = (np.arange(fine * n, dtype=np.float64) for n in size)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    return np.asarray((pixels + 0.5) / (fine * part.zoom) - 0.5 + part.corner)


def _largest(values: NDArray[Any], size: Size) -> Floats:
    """Of each pixel of a picture (H, W) the largest of its values, lest peaks be missed."""
    fine = len(values) // size[1]
    blocks = np.asarray(values, dtype=np.float64).reshape(size[1], fine, size[0], fine)
    return np.asarray(np.maximum(blocks.max(axis=(1, 3)), 0.0))


def _coloured(values: Floats, bottom: float, top: float) -> Picture:
    """Densities in colours, black below `bottom` and brightest at `top`."""
    share = np.log(np.maximum(values, bottom) / bottom) / np.log(top / bottom)
    grey = np.round(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), dtype=np.uint8)


def _bar(width: int, panel: Picture, bottom: float, top: float) -> Picture:
    """The scale of a row of panels as a bar, with the powers of ten on it."""
    line = line_height(panel)
    shares = np.linspace(0, 1, width)
    bar = np.tile(bottom * (top / bottom) ** shares, (max(round(0.4 * line), 4), 1))
    picture = np.zeros((round(_BAR_LINES * line), width, 3), np.uint8)
    picture[: len(bar)] = _coloured(bar, bottom, top)
    first, last = np.ceil(np.log10(bottom)), np.floor(np.log10(top))
    baseline = picture.shape[0] - 0.3 * line
    for power in np.arange(first, last + 1):
        u = width * (power - np.log10(bottom)) / np.log10(top / bottom)
        if u < width - 8 * line:
            picture[: len(bar), max(round(u) - 1, 0) : round(u) + 1] = 255
            words(picture, f"1e{power:.0f}", (u, baseline), WHITE, size=0.8)
    words(picture, f"{top:.1e} / px²", (width - 5 * line, baseline), WHITE, size=0.8)
    return picture

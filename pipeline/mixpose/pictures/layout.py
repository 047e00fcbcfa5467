"""Several pictures in one."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mixpose.pictures.canvas import Picture

_GAP_PX = 4
_GAP_GREY = 70


def columns_for(count: int) -> int:
    """In how many columns so many pictures are laid out."""
    return count if count <= 3 else int(np.ceil(np.sqrt(count)))


def fit_into(picture: Picture, size: tuple[int, int]) -> Picture:
    """A picture amid black of exactly that width and height, shrunk where it is larger."""
    width, height = size
    zoom = min(width / picture.shape[1], height / picture.shape[0], 1.0)
    if zoom < 1.0:
        shrunk = max(int(picture.shape[1] * zoom), 1), max(int(picture.shape[0] * zoom), 1)
        picture = np.asarray(cv2.resize(picture, shrunk, interpolation=cv2.INTER_AREA), np.uint8)
    canvas = np.zeros((height, width, 3), np.uint8)
    v, u = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    canvas[v : v + picture.shape[0], u : u + picture.shape[1]] = picture
    return canvas


def in_grid(
    pictures: Sequence[Picture], columns: int, cell: tuple[int, int] | None = None
) -> Picture:
    """Pictures from left to right, row by row, with gaps between them.

    Cells are of the given width and height, else as wide as the widest and as high as their row.
    """
    width = cell[0] if cell else max(picture.shape[1] for picture in pictures)
    rows = []
    for k in range(0, len(pictures), columns):
        row = list(pictures[k : k + columns])
        height = cell[1] if cell else max(picture.shape[0] for picture in row)
        cells = [fit_into(picture, (width, height)) for picture in row]
        cells += [np.zeros((height, width, 3), np.uint8)] * (columns - len(cells))
        rows.append(_joined(cells, axis=1))
    return _joined(rows, axis=0)


def stacked(pictures: Sequence[Picture]) -> Picture:
    """Pictures one below the other; narrower ones have black beside them."""
    width = max(picture.shape[1] for picture in pictures)
    return _joined([fit_into(each, (width, each.shape[0])) for each in pictures], axis=0)


def _joined(pictures: Sequence[Picture], axis: int) -> Picture:
    shape = [*pictures[0].shape]
    shape[axis] = _GAP_PX
    gap = np.full(shape, _GAP_GREY, np.uint8)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=axis)

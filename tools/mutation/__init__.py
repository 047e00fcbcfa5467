"""Small bugs to be put into the code one at a time, as data: a file for each group of rooms."""

from __future__ import annotations

from mutation import edge, files, geometry, images, recordings
from mutation.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (
    *geometry.MUTANTS,
    *images.MUTANTS,
    *recordings.MUTANTS,
    *files.MUTANTS,
    *edge.MUTANTS,
)

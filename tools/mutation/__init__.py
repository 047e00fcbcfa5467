"""Small bugs to be put into the code one at a time, as data: a file for each group of rooms."""

from __future__ import annotations

from mutation import (
    densities,
    edge,
    estimating,
    files,
    following,
    geometry,
    images,
    planning,
    recordings,
)
from mutation.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (
    *geometry.MUTANTS,
    *images.MUTANTS,
    *recordings.MUTANTS,
    *densities.MUTANTS,
    *estimating.MUTANTS,
    *following.MUTANTS,
    *files.MUTANTS,
    *edge.MUTANTS,
    *planning.MUTANTS,
)

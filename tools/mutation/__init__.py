"""Small bugs to be put into the code one at a time, as data: a file for each group of rooms."""

from __future__ import annotations

from mutation import (
    accepting,
    bodies,
    densities,
    edge,
    elsewhere,
    estimating,
    files,
    following,
    geometry,
    images,
    judging,
    many_bodies,
    matching,
    mistaken,
    objectives,
    planning,
    proposing,
    ranging,
    recordings,
    rivalry,
    searching,
    trajectories,
)
from mutation.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (
    *geometry.MUTANTS,
    *bodies.MUTANTS,
    *images.MUTANTS,
    *recordings.MUTANTS,
    *densities.MUTANTS,
    *objectives.MUTANTS,
    *estimating.MUTANTS,
    *matching.MUTANTS,
    *judging.MUTANTS,
    *accepting.MUTANTS,
    *mistaken.MUTANTS,
    *following.MUTANTS,
    *proposing.MUTANTS,
    *ranging.MUTANTS,
    *searching.MUTANTS,
    *many_bodies.MUTANTS,
    *files.MUTANTS,
    *edge.MUTANTS,
    *elsewhere.MUTANTS,
    *rivalry.MUTANTS,
    *planning.MUTANTS,
    *trajectories.MUTANTS,
)

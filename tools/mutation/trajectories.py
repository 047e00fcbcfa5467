"""Mutants of what learns bodies, smooths poses and finds the floor."""

from __future__ import annotations

from mutation.mutant import Mutant

MUTANTS = (
    Mutant(
        "trajectories-least-by-the-widest-pose",
        "trajectories/track.py",
        "floor = np.where(some, _FLOOR * each[:, None], typical)",
        "floor = np.where(some, _FLOOR * each.max(), typical)",
        "a pose that says nothing makes all others say nothing",
        ("test_smooth_choices.py",),
    ),
    Mutant(
        "trajectories-tell-the-size-of-a-body",
        "trajectories/smoothing.py",
        "if line.doubt and line.confidence is not None:",
        "if False:",
        "a body of another size is ok where it moves smoothly",
        ("test_smooth_choices.py",),
    ),
    Mutant(
        "learning-by-few-triples-alone",
        "learning/bodies.py",
        "least, RULES.many_bases)",
        "least, RULES.bases)",
        "a body that shows few of its markers for a while is learnt twice",
        ("test_learn.py",),
    ),
    Mutant(
        "trajectories-floor-of-a-body-that-turns",
        "trajectories/floor.py",
        "        _require_still(estimates, T)",
        "        pass",
        "the floor is that of a tool in the middle of its turns",
        ("test_align.py",),
    ),
)

"""What is believed of bodies that share a scene."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class SceneRules:
    """How detections are shared out, and when bodies are in doubt for each other's sake."""

    gate: float = constant(
        6.0,
        "σ_ε around expected features within which detections are the body's: they are met "
        "within 2.2, and a steady prediction errs by less than the rest",
    )
    reach: float = constant(
        9.0,
        "σ_ε around features within which another's detection would pull: it is drawn to 5, "
        "and the pose moves by the rest",
    )
    rounds: int = constant(
        3, "times that detections are shared out again: neighbours' neighbours are settled by then"
    )
    rival: float = constant(
        0.5,
        "share of the detections of one body, met by another too, from which it is either the "
        "one or the other; below, their images only touch",
    )
    touching: float = constant(
        3.0,
        "σ_ε between a spot and another body's feature that is seen nowhere else: images of "
        "spots run together at twice their width",
    )
    pulled: float = constant(
        0.1,
        "squared offset in σ_ε² from which such a spot is taken for both: two and a half "
        "times what blobs have (0.2²)",
    )
    forgotten: int = constant(
        5,
        "frames without a pose after which identical bodies are searched for as one: velocities "
        "are believed for as many",
    )
    thorough: int = constant(
        10,
        "frames of which one is searched thoroughly for a body that is away: a third of a second "
        "of video; the others have the budget of live streams, which goes on from frame to frame",
    )

"""Settings of the learning of bodies, with reasons."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class LearningRules:
    """Gates, shares and limits of the learning of bodies from a recording."""

    widest: float = constant(3.0, "σ_ε that rays may miss each other by while the noise is unknown")
    gate: float = constant(3.5, "standard deviations within which two points are the same")
    unlike: float = constant(
        2.0, "times the noise of all points: if moving ones have more, theirs is also tried"
    )
    quietest: float = constant(0.02, "of σ_ε: noise that is at least assumed")
    of_clouds: float = constant(
        0.2, "of σ_ε: noise of points of clouds, which do not show it; that of most detections"
    )
    probes: int = constant(60, "frames from which the noise of detections is estimated")
    still_share: float = constant(
        0.5, "of the frames: a point at one place of the world in so many does not move"
    )
    references: int = constant(6, "frames from whose points shapes are formed")
    neighbours: int = constant(
        7, "of a point, two of which form a triple with it: bodies are compact, clutter is not"
    )
    triples: int = constant(120, "of neighbours in a reference frame that are tried")
    compared: int = constant(24, "frames in which each triple is searched")
    far_triples: int = constant(120, "of points anywhere that are tried: some bodies are wide")
    apart: float = constant(
        6.0, "gates by which a body must have moved for a frame to add information about it"
    )
    looser: tuple[float, ...] = constant(
        (1.0, 4.0, 12.0),
        "times the error of triangulation: allowed offsets of points, as on skin and cloth",
    )
    worth: float = constant(1.15, "times the frames of a tighter body that a looser one must be in")
    least_frames: int = constant(5, "at different poses, in which a marker or a body must be seen")
    least_share: float = constant(
        0.1, "of the frames of a body in which a marker must be seen: ghosts are in 0.03 or less"
    )
    alike: float = constant(
        2.0, "gates within which two markers are one: cameras out of step show one 1.5 apart"
    )
    gathered: float = constant(
        0.6, "of the points within three gates of a marker: share that must be within one gate"
    )
    by_chance: float = constant(
        4.0, "times the frequency of other sizes with which a triangle of markers must recur"
    )
    rounds: int = constant(3, "of estimating markers from poses, and poses from markers")
    placements: int = constant(12, "poses of a shape in a frame that are refined, times copies")
    bases: int = constant(12, "triples of a shape by which it is searched in a frame")
    many_bases: int = constant(
        100, "where these fail: four markers of ten seen include one of 12 triples in 0.34 of cases"
    )
    adjusted: int = constant(
        240, "frames that are adjusted together, those with most information; as in calibrate"
    )
    most_frames: int = constant(400, "that are read: a longer recording is thinned out evenly")
    most_bodies: int = constant(60, "that are searched")
    turned_deg: float = constant(
        15.0, "turn below which a body may include other things that moved along with it"
    )


RULES = LearningRules()

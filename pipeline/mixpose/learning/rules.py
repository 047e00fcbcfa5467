"""What learning a body goes by, with reasons."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class LearningRules:
    """Gates, shares and limits of learning bodies from a recording."""

    widest: float = constant(3.0, "σ_ε that rays may miss each other by where noise is not known")
    gate: float = constant(3.5, "standard deviations within which things are the same")
    unlike: float = constant(
        2.0, "times the noise of all, from which what moves is looked for by its own as well"
    )
    quietest: float = constant(0.02, "of σ_ε: less noise than that is not believed")
    of_clouds: float = constant(
        0.2, "of σ_ε that points of clouds err by, which do not tell it: as detections as a rule"
    )
    probes: int = constant(60, "frames that the noise of detections is told by")
    still_share: float = constant(
        0.5, "of the frames in which something is at one place of the world: it does not move"
    )
    references: int = constant(6, "frames whose points shapes are taken from")
    neighbours: int = constant(
        7, "of a point, of which two make a triple with it: bodies are compact, clutter is not"
    )
    triples: int = constant(120, "of a reference frame that are tried")
    compared: int = constant(24, "frames in which each of them is looked for")
    far_triples: int = constant(120, "likewise, of points anywhere: some bodies are wide")
    apart: float = constant(
        6.0, "gates by which a body must be elsewhere for a frame to tell anything new of it"
    )
    looser: tuple[float, ...] = constant(
        (1.0, 4.0, 12.0),
        "times the error of triangulation that points of a body may be off, as on skin and cloth",
    )
    worth: float = constant(1.15, "times as many frames as a tighter body a looser one must be in")
    least_frames: int = constant(
        5, "in which a marker, or a body, must be seen, at poses apart from each other"
    )
    least_share: float = constant(
        0.1, "of the frames of a body in which a marker must be seen: ghosts are in 0.03 and less"
    )
    alike: float = constant(
        2.0, "gates within which two markers are one: of cameras out of step they are 1.5 off"
    )
    gathered: float = constant(
        0.6, "of points within three gates of a marker's place that must be within one"
    )
    by_chance: float = constant(
        4.0, "times as often as triangles of other sizes, a triangle of three markers must recur"
    )
    rounds: int = constant(3, "of finding markers by poses, and poses by markers")
    placements: int = constant(12, "motions of a shape into a frame that are refined, times copies")
    bases: int = constant(12, "triples of a shape by which it is found in a frame")
    many_bases: int = constant(
        100, "likewise, where it was not found: four markers of ten show one of 12 in 0.34 of cases"
    )
    adjusted: int = constant(
        240, "frames that are adjusted together, those that add most information; as in calibrate"
    )
    most_frames: int = constant(400, "read: a longer recording is thinned out evenly")
    most_bodies: int = constant(60, "different ones that are looked for")
    turned_deg: float = constant(
        15.0, "a body that turned less may be one with whatever else moved along"
    )


RULES = LearningRules()

"""The object model q: features, their samples, and the body's symmetries."""

from __future__ import annotations

from mixpose.body.features import Feature, PointFeature, SegmentFeature, Spread
from mixpose.body.look_alikes import (
    ASIDE,
    LookAlike,
    congruent_parts,
    like_features,
    mirror_image,
    other_tilt,
    thickness,
    tolerance_of,
)
from mixpose.body.model import Body, Gravity, Nodes, Shape
from mixpose.body.sampling import Sampler, uniforms
from mixpose.body.symmetry import symmetries

__all__ = [
    "ASIDE",
    "Body",
    "Feature",
    "Gravity",
    "LookAlike",
    "Nodes",
    "PointFeature",
    "Sampler",
    "SegmentFeature",
    "Shape",
    "Spread",
    "congruent_parts",
    "like_features",
    "mirror_image",
    "other_tilt",
    "symmetries",
    "thickness",
    "tolerance_of",
    "uniforms",
]

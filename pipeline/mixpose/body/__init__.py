"""The object model q: features, their samples, and the body's symmetries."""

from __future__ import annotations

from mixpose.body.features import Feature, PointFeature, SegmentFeature, Spread
from mixpose.body.model import Body, Gravity, Nodes, Shape
from mixpose.body.sampling import Sampler, uniforms
from mixpose.body.shared_parts import SharedPart, shared_parts
from mixpose.body.symmetry import symmetries

__all__ = [
    "Body",
    "Feature",
    "Gravity",
    "Nodes",
    "PointFeature",
    "Sampler",
    "SegmentFeature",
    "Shape",
    "SharedPart",
    "Spread",
    "shared_parts",
    "symmetries",
    "uniforms",
]

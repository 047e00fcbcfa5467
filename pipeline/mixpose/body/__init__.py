"""Object model q: features, their samples, and the symmetries of the body."""

from mixpose.body.features import (
    Feature as Feature,
    PointFeature as PointFeature,
    Sampler as Sampler,
    SegmentFeature as SegmentFeature,
    Spread as Spread,
    uniforms as uniforms,
)
from mixpose.body.look_alikes import (
    ASIDE as ASIDE,
    FEWEST as FEWEST,
    TURNED as TURNED,
    LookAlike as LookAlike,
    congruent_parts as congruent_parts,
    like_features as like_features,
    mirror_image as mirror_image,
    reflection as reflection,
    of_points as of_points,
    of_size as of_size,
    other_tilt as other_tilt,
    thickness as thickness,
    tolerance_of as tolerance_of,
)
from mixpose.body.model import Body as Body, Gravity as Gravity, Nodes as Nodes, Shape as Shape
from mixpose.body.symmetry import (
    default_tolerance as default_tolerance,
    is_on_a_line as is_on_a_line,
    symmetries as symmetries,
)

"""What can be said of a session before its poses are estimated.

`recordings` reads every frame and counts features in some, `advice` says which key to change where
the count is off and the body is found with that change, `sensor_keys` doubts calibrations and
widths, `placement` looks at where sensors stand and the body starts, `lookalikes` finds poses that
the sensors could not tell apart, `shared_parts` bodies that could be taken for each other,
`shared_sources` recordings that are given twice, `typical` has poses where the session names no
start.  `geometry` takes a few frames all over the recording, and `trials` tries what else the
session could have said: `changes` of it as a whole, and `values` that are `adjusted` to what
sensors met (`meetings`); `evidence` says how well frames are explained, `rules` when a change is
told.
"""

from __future__ import annotations

from mixpose.checking.advice import advice, judge, told_apart
from mixpose.checking.geometry import CAUSES, Doubts, geometry_doubts
from mixpose.checking.lookalikes import LookAlike, look_alikes, noise_of
from mixpose.checking.placement import (
    expected_count,
    fewest_count,
    placement_lines,
    placement_warnings,
)
from mixpose.checking.recordings import Survey, image_of, numbers_of, some_of, survey
from mixpose.checking.keys import key_warnings
from mixpose.checking.keys import shared_part_warnings
from mixpose.checking.keys import shared_source_warnings
from mixpose.checking.trials import explanation
from mixpose.checking.typical import depends_on_distance, typical_poses, with_image_sizes

__all__ = [
    "CAUSES",
    "Doubts",
    "LookAlike",
    "Survey",
    "advice",
    "depends_on_distance",
    "expected_count",
    "explanation",
    "fewest_count",
    "geometry_doubts",
    "image_of",
    "judge",
    "key_warnings",
    "look_alikes",
    "noise_of",
    "numbers_of",
    "placement_lines",
    "placement_warnings",
    "shared_part_warnings",
    "shared_source_warnings",
    "some_of",
    "survey",
    "told_apart",
    "typical_poses",
    "with_image_sizes",
]

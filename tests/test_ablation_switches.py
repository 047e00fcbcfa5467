"""Rows of the ablation that name a kind of look-alike switch off that kind and no other."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from detections import TRUTH, detect

from mixpose.body import Body, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.likelihood import Start, likelihood_of
from mixpose.tracking.proposers import look_alikes

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
from ablated.switches import SWITCHES

SQUARE = np.array([[-40, -40, 0], [40, -40, 0], [40, 40, 0], [-40, 40, 0], [9, 70, 0.0]])
BODY = Body("square", tuple(PointFeature(point) for point in SQUARE))


@pytest.mark.parametrize(
    ("name", "tilts", "turns"),
    [("no congruent features", 1, 0), ("no other tilt", 0, 7), ("no mirror image", 1, 7)],
)
def test_a_row_switches_off_the_kind_of_look_alike_that_it_names(
    pinhole_cameras: list[PinholeCamera], name: str, tilts: int, turns: int
) -> None:
    (switch,) = (one for one in SWITCHES if one.name == name)
    tracker = switch.change(Tracker.create(BODY, EstimatorOptions()))
    shown = Body("tag", BODY.features[:4])
    data = tracker.data(tracker.begin(), 0, None, detect(pinhole_cameras[:1], shown, TRUTH))
    likelihood, start = likelihood_of(data), Start(TRUTH)
    ranked = [likelihood.judge(likelihood.fit(start), start)]
    starts = list(look_alikes(data, ranked))
    # the other tilt begins with as much doubt as a prediction has
    wide = [
        one
        for one in starts
        if one.uncertainty is not None and (one.uncertainty > data.close).any()
    ]
    assert (len(wide), len(starts) - len(wide)) == (tilts, turns)
    assert ("mirrored" in tracker.rules.look_alikes.kinds) == (name != "no mirror image")

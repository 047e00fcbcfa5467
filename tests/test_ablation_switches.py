"""Rows of the ablation really switch off what they name."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import tee
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from detections import TRUTH, detect

from mixpose.body import Body, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.frame import Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.proposers import look_alikes

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
from ablated.cases import Case, all_on, loose_start_case, room_case, search_case
from ablated.recordings import DEFORMED, real_cases, simulated_cases, synthetic_cases
from ablated.switches import SWITCHES
from benchmarks.search_cases import rows_named

Told: TypeAlias = Iterator[tuple[object, ...]]

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
        if one.uncertainty is not None and (one.uncertainty > data.close_uncertainty).any()
    ]
    assert (len(wide), len(starts) - len(wide)) == (tilts, turns)
    assert ("mirrored" in tracker.rules.look_alikes.kinds) == (name != "no mirror image")


# Where what a row switches off matters; rows of look-alikes stand above.
SHOWN_BY = {
    "no multistart": "a loose start, 60 false",
    "no searched": "2 parallel 6/0/0",
    "static clutter searched alike": "enters among 10 lamps",
    "no merged_pair": "fast",
    "no agreed": "spots that touch",
    "sizes tell nothing": "two_cameras",
    "no without_sensor": "a knocked camera",
    "nothing merged": "fast",
    "misses free": "1 pinhole 5/0/5",
    "unseen free": "1 pinhole 8/3/5",
    "clutter even": "1 pinhole 5/0/5",
    "payment by volume": "1 pinhole 5/0/5",
    "prior flat": "a loose start, 60 false",
    "no velocity": "two_cameras",
    "noise: no memory": "two_cameras",
    "noise: no outdone": "real_room",
    "noise: no typical": "two_cameras",
    "noise: no offsets before they are seen": "two_cameras",
    "noise: nothing lasts": "a camera slightly turned",
    "blurs end at σ_ε": "fast",
    "noise of few residuals as of many": "two_cameras",
    "late sensors taken as in time": "real_room",
    "features equally bright": "range_profiles",
    "misfit taken for noise": DEFORMED,
    "blurs always": "two_cameras",
    "blurs never": "fast",
    "not looked elsewhere": "a knocked camera",
    "nothing doubted": "flat and small",
}
SHOWN_BY_REAL = {
    "no all_near": "webcams4_a",
    "no fusion of ranges": "uwb_trolley",
    "any turn sure": "uwb_trolley",
}
FRAMES, TRIALS = 12, 2


@pytest.fixture(scope="module")
def case_named(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Case]:
    """Cases of the ablation, each made once and cut to a few frames."""
    made: dict[str, Case] = {}

    def case(name: str) -> Case:
        if name not in made:
            made[name] = _made(name, tmp_path_factory.mktemp("cases"))
        return made[name]

    return case


@pytest.fixture(scope="module")
def told_with_all(case_named: Callable[[str], Case]) -> Callable[[str], Told]:
    """What is told of a case with nothing switched off, once for all rows that it shows."""
    told: dict[str, Told] = {}

    def of(name: str) -> Told:
        told[name], again = tee(told.get(name) or _told(case_named(name), all_on))
        return again

    return of


def _made(name: str, folder: Path) -> Case:
    for row in rows_named([]):
        if row.name == name:
            return search_case(row, TRIALS)
    if name.startswith("a loose start"):
        return loose_start_case(TRIALS)
    if name.startswith("enters"):
        return room_case(1)
    (case,) = [*synthetic_cases([name]), *simulated_cases(folder, [name])]
    cut = [replace(one, frames=one.frames[:FRAMES]) for one in case.recordings]
    return replace(case, recordings=cut)


def _told(case: Case, change: Callable[[Tracker], Tracker]) -> Told:
    """All that is told of each frame, when it is asked for."""
    for recording in case.recordings:
        tracker = change(recording.tracker)
        track = tracker.begin()
        for frame in recording.frames:
            track, found = tracker.advance(track, frame.number, frame.time_s, frame.views)
            poses = [np.asarray(one.T_world_object).tobytes() for one in found.hypotheses]
            best = np.asarray(found.T_world_object), np.asarray(found.covariance)
            weights = [one.weight for one in found.hypotheses]
            yield (found.status, *(one.tobytes() for one in best), poses, weights)


def _differ(told: Told, others: Told) -> bool:
    """Whether any frame does; those after it need not be estimated."""
    return any(one != other for one, other in zip(told, others, strict=True))


@pytest.mark.parametrize("name", SHOWN_BY)
def test_a_row_changes_poses_or_what_is_told_of_them(
    name: str,
    case_named: Callable[[str], Case],
    told_with_all: Callable[[str], Told],
) -> None:
    (switch,) = (one for one in SWITCHES if one.name == name)
    shown = SHOWN_BY[name]
    assert _differ(_told(case_named(shown), switch.change), told_with_all(shown))


@pytest.mark.parametrize("name", SHOWN_BY_REAL)
def test_a_row_changes_what_is_told_of_real_ranges(name: str, recordings: Path) -> None:
    (switch,) = (one for one in SWITCHES if one.name == name)
    (case,) = real_cases(recordings, [SHOWN_BY_REAL[name]])
    assert _differ(_told(case, switch.change), _told(case, all_on))


def test_every_row_is_shown_to_switch_something_off() -> None:
    shown = {"no congruent features", "no other tilt", "no mirror image"}
    assert {one.name for one in SWITCHES} == {*shown, *SHOWN_BY, *SHOWN_BY_REAL}

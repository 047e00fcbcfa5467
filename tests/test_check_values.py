"""Values that `mixpose check` takes for wrong: the size of a body, where a camera stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnosed import (
    poses,
)

from mixpose.checking.evidence import CameraMatches
from mixpose.checking.rules import DiagnosisRules
from mixpose.checking.values import Adjustment, adjusted, promise, unknowns
from mixpose.rigid import perturb, transform
from mixpose.session import Session, load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
MOVED = np.array([1.5, -2.0, 1.0, 0.004, -0.01, 0.006])


@pytest.fixture
def right() -> Session:
    session = load_session(SYNTHETIC / "two_cameras" / "session.toml")
    return replace(session, start=None)


def exact(session: Session, points: np.ndarray) -> list[list[CameraMatches]]:
    """What the cameras meet of a body without noise, all at once."""
    return [
        [
            CameraMatches(
                each.name,
                np.arange(7),
                each.sensor.project(transform(T, points))[0],
                np.full(7, 0.3),
                np.zeros(7),
            )
            for each in session.sensors
        ]
        for T in poses()
    ]


def given_to(session: Session, frames: Sequence[Sequence[CameraMatches]]) -> Adjustment:
    sensors = {setup.name: setup.sensor for setup in session.sensors}
    return Adjustment(session.body.means, sensors, frames, poses())


def test_least_squares_find_the_size_of_what_was_met(right: Session) -> None:
    middle = right.body.means.mean(axis=0)
    larger = middle + 1.03 * (right.body.means - middle)
    size = next(iter(unknowns(right)))
    given = given_to(right, exact(right, larger))
    found = adjusted(size, given)
    assert found is not None
    np.testing.assert_allclose(found[0], [0.03], atol=1e-5)
    assert promise(size, given) > 15
    assert promise(size, given_to(right, exact(right, right.body.means))) < 1e-3


def test_what_a_neighbour_shows_in_place_of_a_hidden_marker_promises_little(right: Session) -> None:
    """One detection 30 deviations off gains no more than clutter; the same off in all gains all."""
    marker = next(each for each in unknowns(right) if each.feature == 2)
    frames = exact(right, right.body.means)
    off = np.zeros((7, 2))
    off[2] = 9.0  # px
    first = frames[0][0]
    frames[0][0] = replace(first, observed=first.observed + off)
    assert promise(marker, given_to(right, frames)) < DiagnosisRules().promise
    moved = np.array(right.body.means)
    moved[2] += [3.0, -4.0, 0.0]
    assert promise(marker, given_to(right, exact(right, moved))) > 2 * DiagnosisRules().promise


def test_a_cut_spot_pulls_as_little_as_it_says(right: Session) -> None:
    """A hundredth of the weight: one 9 px off moves a marker by less than a tenth of a mm."""
    marker = next(each for each in unknowns(right) if each.feature == 2)
    frames = exact(right, right.body.means)
    first, noise = frames[0][0], np.full(7, 0.3)
    noise[2] = 30.0
    off = np.zeros((7, 2))
    off[2] = 9.0
    frames[0][0] = replace(first, observed=first.observed + off, noise=noise)
    found = adjusted(marker, given_to(right, frames))
    assert found is not None
    assert np.linalg.norm(found[0]) < 0.1


def test_a_body_that_moves_before_a_late_camera_is_no_camera_that_stands_elsewhere(
    right: Session,
) -> None:
    """5 ms later it has moved by 3 mm and turned by 0.3°, in each frame another way."""
    moved = [each for each in unknowns(right) if "T_sensor_world" in each.what]
    rng, frames = np.random.default_rng(2), exact(right, right.body.means)
    late, name = 0.005, right.sensors[1].name
    for own, T in zip(frames, poses()):
        shift, turn = rng.standard_normal((2, 3))
        twist = np.concatenate([3.0 * shift / np.linalg.norm(shift), 0.003 * turn])
        y = right.sensors[1].sensor.project(transform(perturb(T, twist), right.body.means))[0]
        own[1] = replace(own[1], observed=y)
    at_once = max(promise(each, given_to(right, frames)) for each in moved)
    told = [[replace(s, seconds=np.full(7, late * (s.name == name))) for s in f] for f in frames]
    assert at_once > 5 * DiagnosisRules().promise
    assert max(promise(each, given_to(right, told)) for each in moved) < DiagnosisRules().promise
    # one that stands 11° otherwise, in all frames alike, is seen to do so
    other = moved[1].sensor(name, right.sensors[1].sensor, np.array([0, 0, 0, 0, 0, 0.2]))
    for own, T in zip(told, poses()):
        y = other.project(transform(T, right.body.means))[0]
        own[1] = replace(own[1], observed=y)
    assert max(promise(each, given_to(right, told)) for each in moved) > DiagnosisRules().promise


def test_too_few_matches_say_nothing_of_values(right: Session) -> None:
    size = next(iter(unknowns(right)))
    few = [[one.only(slice(2)) for one in frame[:1]] for frame in exact(right, right.body.means)]
    assert adjusted(size, given_to(right, few)) is None
    assert promise(size, given_to(right, few)) == 0.0


@pytest.mark.parametrize(("more", "says"), [(2, False), (3, True)])
def test_values_are_asked_for_from_four_coordinates_beyond_what_is_sought(
    more: int, says: bool, right: Session
) -> None:
    """Three features a frame tell poses alone; a size and the four beyond it are five."""
    size = next(iter(unknowns(right)))
    middle = right.body.means.mean(axis=0)
    frames = exact(right, middle + 1.03 * (right.body.means - middle))
    # nor does a coordinate gain more than what is 3 deviations off, 4.5 nats
    assert 0.0 < promise(size, given_to(right, frames)) < 4.5 * given_to(right, frames).count
    some = []
    for k, (first, second) in enumerate(frames):
        counts = [(first, slice(0, 3)), (second, slice(0, more if k == 0 else 0))]
        some.append([seen.only(n) for seen, n in counts if n.stop])
    assert given_to(right, some).count == 6 * len(some) + 2 * more
    assert (promise(size, given_to(right, some)) > 0.0) == says


def test_least_squares_find_where_a_camera_stands(right: Session) -> None:
    left, other = right.sensors
    camera: Any = other.sensor
    moved = replace(camera, T_sensor_world=perturb(camera.T_sensor_world, MOVED))
    there = replace(right, sensors=(left, replace(other, sensor=moved)))
    off = [u for u in unknowns(right) if u.what.startswith("T_sensor_world of 'right'")]
    found = adjusted(off[0], given_to(right, exact(there, right.body.means)))
    assert found is not None
    np.testing.assert_allclose(found[0], MOVED, atol=2e-3)  # of 2 mm and 0.01 rad, by the prior

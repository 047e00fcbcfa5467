"""Parts that bodies have in common, and what is said of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mixpose.body import (
    ASIDE,
    Body,
    LookAlike,
    PointFeature,
    congruent_parts,
    like_features,
    symmetries,
    tolerance_of,
)
from mixpose.checking.keys import shared_part_warnings
from mixpose.records import Floats
from mixpose.rigid import from_rotation_vector, transform
from mixpose.session import load_session

FIVE = np.array([[0, 0, 0], [60, 5, 0], [-20, 50, 10], [11, -37, 41], [35, 30, -40.0]])
MOTION = from_rotation_vector([0.4, -1.1, 0.7], [12.0, -30.0, 55.0])


def parts_of(points: Floats, other: Floats, tolerance: float) -> tuple[LookAlike, ...]:
    one = Body("body", tuple(map(PointFeature, points)))
    another = one if other is points else Body("body", tuple(map(PointFeature, other)))
    return congruent_parts(one, another, tolerance)


def test_a_body_and_its_copy_share_all_markers_whatever_their_order() -> None:
    order = np.array([3, 0, 4, 2, 1])
    (part,) = parts_of(FIVE, transform(MOTION, FIVE)[order], 0.01)
    assert part.features == (0, 1, 2, 3, 4)
    assert [int(order[j]) for j in part.partners] == [0, 1, 2, 3, 4]
    assert part.off < 1e-9
    np.testing.assert_allclose(part.T_body_other @ MOTION, np.eye(4), atol=1e-9)


def test_three_markers_in_common_are_found_within_what_they_err_by() -> None:
    rng = np.random.default_rng(4)
    other = np.concatenate([FIVE[[1, 2, 4]] + 0.3, [[90.0, -70.0, 20.0]]])
    other = transform(MOTION, other + 0.1 * rng.standard_normal(other.shape))
    assert parts_of(FIVE, other, 0.01) == ()
    (part,) = parts_of(FIVE, other, 0.5)
    assert (part.features, part.partners) == ((1, 2, 4), (0, 1, 2))
    assert 0.01 < part.off < 0.5


def test_a_mirror_image_is_no_copy() -> None:
    parts = parts_of(FIVE, FIVE * [1, 1, -1], 0.01)
    assert all(len(part.features) == 3 for part in parts)  # three points are their own mirror image


def test_a_body_by_itself_shares_nothing_but_what_it_repeats() -> None:
    assert parts_of(FIVE, FIVE, 0.01) == ()
    isosceles = np.array([[0, 30, 0], [-20, 0, 0], [20, 0, 0], [5, 8, 40.0]])
    (part,) = parts_of(isosceles, isosceles, 0.01)
    assert (part.features, part.partners) == ((0, 1, 2), (0, 2, 1))


@pytest.mark.parametrize(
    ("moved", "size", "said"),
    [
        (0.0, 1.0, "'a' and 'b' are congruent"),
        (8.0, 1.0, "4 markers of 'a' lie"),
        # one camera knows no size
        (0.0, 0.8, "'a' and 'b', 1.25 times as large, are congruent"),
    ],
)
def test_a_session_is_warned_of_bodies_that_could_be_taken_for_each_other(
    tmp_path: Path, moved: float, size: float, said: str
) -> None:
    other = size * transform(MOTION, FIVE)
    other[4] += moved
    path = tmp_path / "session.toml"
    path.write_text(
        'unit = "mm"\n'
        f'[[object]]\nname = "a"\npoints = {FIVE.tolist()}\n'
        f'[[object]]\nname = "b"\npoints = {other.tolist()}\n'
        '[[sensor]]\nname = "left"\nmodel = "pinhole"\nsource = "left.csv"\n'
        "resolution = [1280, 1024]\n"
        "camera_matrix = [[1000, 0, 640], [0, 1000, 512], [0, 0, 1]]\n"
    )
    (warning,) = shared_part_warnings(load_session(path))
    assert said in warning
    assert "1 like 1, 2 like 2" in warning  # markers are called as in other messages


@pytest.mark.parametrize(("scale", "said"), [(1.0, []), (0.1, ["4 markers of 'a' lie like 4"])])
def test_coarse_images_cannot_tell_bodies_apart_that_fine_ones_can(
    tmp_path: Path, scale: float, said: list[str]
) -> None:
    # markers are 2 mm elsewhere; they err by 0.07 mm in images of 1280 px, and by ten times as much
    # in images of 128
    off = 2.0 * np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0]])
    width, height, focal = (round(scale * length) for length in (1280, 1024, 1000))
    path = tmp_path / "session.toml"
    path.write_text(
        'unit = "mm"\n'
        f'[[object]]\nname = "a"\npoints = {FIVE.tolist()}\n'
        f'[[object]]\nname = "b"\npoints = {transform(MOTION, FIVE + off).tolist()}\n'
        '[[sensor]]\nname = "left"\nmodel = "pinhole"\nsource = "left.csv"\n'
        f"resolution = [{width}, {height}]\n"
        f"camera_matrix = [[{focal}, 0, {width / 2}], [0, {focal}, {height / 2}], [0, 0, 1]]\n"
    )
    warnings = shared_part_warnings(load_session(path))
    assert [warning[: len(text)] for warning, text in zip(warnings, said, strict=True)] == said


def test_what_is_met_of_a_square_lies_like_it_turned_and_like_every_other_square() -> None:
    square = np.array([[0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0.0]])
    aside = square + np.array([80.0, 30, 0])
    body = Body("plate", tuple(PointFeature(point) for point in (*square, *aside, [20, 90, 0])))
    tolerance = tolerance_of(body, body, 0.05)
    alike = like_features(body, frozenset(range(4)), body, tolerance)
    # three other turns of itself and four of the other square, either face up
    assert len(alike) == 3 + 4 + 8
    assert {round(one.turn_deg) for one in alike} == {0, 90, 180}
    (step,) = (one for one in alike if one.turn_deg < 1)
    assert step.reason == ASIDE
    there = transform(step.T_body_other, body.means[list(step.partners)])
    np.testing.assert_allclose(there, body.means[list(step.features)], atol=1e-9)
    # normals tell which face is up, and what is met beside a square that is not one
    facing = Body(body.name, body.features, np.tile([0.0, 0.0, 1.0], (9, 1)))
    assert len(like_features(facing, frozenset(range(4)), facing, tolerance)) == 3 + 4
    # of all features one may go without a partner: both squares turned by half a turn
    (half,) = like_features(facing, frozenset(range(9)), facing, tolerance)
    assert half.features == tuple(range(8))
    assert half.reason == "the body explains as much turned by 180 deg"


def test_the_products_of_symmetries_are_symmetries() -> None:
    # corners of a square prism: quarter turns are off by more than half turns about its sides
    angles = np.radians([44.4, 135.6, 224.4, 315.6])
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(4)])
    up = np.array([0.0, 0, 1])
    points = np.concatenate([around + up, around - up])
    found = symmetries(points, 0.013)
    products = (found[:, None] @ found[None]).reshape(-1, 4, 4)
    assert len(found) > 1
    for T in products:
        assert np.abs(T - found).max(axis=(1, 2)).min() < np.radians(2.0)


def test_a_board_is_laid_on_itself_at_once() -> None:
    """Of 24,804 triples of 54 corners the first has the whole board; all took two minutes."""
    x, y = np.meshgrid(np.linspace(0, 200, 9), np.linspace(0, 125, 6))
    board = np.asarray(np.column_stack([x.ravel(), y.ravel(), np.zeros(54)]), dtype=np.float64)
    parts = parts_of(board, board + np.random.default_rng(0).normal(0, 0.1, board.shape), 1.0)
    assert {len(part.features) for part in parts} == {54}
    assert len(parts) == 4  # turned by half a turn, and from behind

"""Parts that bodies have in common, and what is said of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mixpose.body import shared_parts
from mixpose.checking import shared_part_warnings
from mixpose.rigid import from_rotation_vector, transform
from mixpose.session import load_session

FIVE = np.array([[0, 0, 0], [60, 5, 0], [-20, 50, 10], [11, -37, 41], [35, 30, -40.0]])
MOTION = from_rotation_vector([0.4, -1.1, 0.7], [12.0, -30.0, 55.0])


def test_a_body_and_its_copy_share_all_markers_whatever_their_order() -> None:
    order = np.array([3, 0, 4, 2, 1])
    (part,) = shared_parts(FIVE, transform(MOTION, FIVE)[order], 0.01)
    assert part.own == (0, 1, 2, 3, 4)
    assert [int(order[j]) for j in part.others] == [0, 1, 2, 3, 4]
    assert part.off < 1e-9
    np.testing.assert_allclose(part.T_body_other @ MOTION, np.eye(4), atol=1e-9)


def test_three_markers_in_common_are_found_within_what_they_err_by() -> None:
    rng = np.random.default_rng(4)
    other = np.concatenate([FIVE[[1, 2, 4]] + 0.3, [[90.0, -70.0, 20.0]]])
    other = transform(MOTION, other + 0.1 * rng.standard_normal(other.shape))
    assert shared_parts(FIVE, other, 0.01) == []
    (part,) = shared_parts(FIVE, other, 0.5)
    assert (part.own, part.others) == ((1, 2, 4), (0, 1, 2))
    assert 0.01 < part.off < 0.5


def test_a_mirror_image_is_no_copy() -> None:
    parts = shared_parts(FIVE, FIVE * [1, 1, -1], 0.01)
    assert all(len(part.own) == 3 for part in parts)  # three points are their own mirror image


def test_a_body_by_itself_shares_nothing_but_what_it_repeats() -> None:
    assert shared_parts(FIVE, FIVE, 0.01) == []
    isosceles = np.array([[0, 30, 0], [-20, 0, 0], [20, 0, 0], [5, 8, 40.0]])
    (part,) = shared_parts(isosceles, isosceles, 0.01)
    assert (part.own, part.others) == ((0, 1, 2), (0, 2, 1))


@pytest.mark.parametrize(("moved", "said"), [(0.0, "are congruent"), (8.0, "4 markers of 'a' lie")])
def test_a_session_is_warned_of_bodies_that_could_be_taken_for_each_other(
    tmp_path: Path, moved: float, said: str
) -> None:
    other = transform(MOTION, FIVE)
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
    assert "0 like 0, 1 like 1" in warning

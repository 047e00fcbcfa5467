"""Which of identical bodies is which: by their motion, and by their distances to each other."""

from __future__ import annotations

from itertools import permutations
from math import log, sqrt

import numpy as np
import pytest
from bodies_in_view import TOOL, at, body, off, scene_of, views_of
from scipy.stats import t as student

from mixpose.records import Indices
from mixpose.tracking.identity import Assignment
from mixpose.tracking.motion import Distances, MotionRules

DEGREES, ROOM = 3.0, 900.0


def drawn(seed: int, bodies: int = 5, poses: int = 5, *, hidden: int = 0) -> Assignment:
    """Bodies that have poses, and distances, by chance; two of them were never seen together.

    Each was `hidden` for so many frames at the most.
    """
    rng = np.random.default_rng(seed)
    likely = np.column_stack([rng.normal(0.0, 6.0, (bodies, poses)), np.zeros(bodies)])
    places = np.concatenate([rng.uniform(0.0, 300.0, (poses, 3)), np.full((1, 3), np.nan)])
    before = rng.uniform(50.0, 300.0, (bodies, bodies))
    before = (before + before.T) / 2
    before[0, 1] = before[1, 0] = np.nan
    missed = np.add.outer(*2 * [rng.integers(0, hidden + 1, bodies)])
    known = Distances(before, np.full_like(before, 800.0), np.full_like(before, 2.0), missed)
    now = np.linalg.norm(places[:, None] - places, axis=2)
    return Assignment(likely, known, now, DEGREES, ROOM)


def log_likelihood(one: Assignment, given: Indices) -> float:
    """Written out: of each body its pose, of each pair of them the change of its distance."""
    total, (before, squares, count, missed) = 0.0, one.before
    for i, p in enumerate(given):
        total += one.likely[i, p]
        for j in range(i):
            now, scale = one.now[p, given[j]], sqrt(squares[i, j] / count[i, j])
            if np.isnan(now):
                continue
            if np.isnan(before[i, j]):
                total -= log(ROOM)
            else:
                scale *= 1 + missed[i, j]
                total += student.logpdf(now, DEGREES, before[i, j], scale)
    return total


@pytest.mark.parametrize("seed", range(4))
def test_the_odds_of_an_exchange_are_those_of_all_bodies_together(seed: int) -> None:
    one, given = drawn(seed, hidden=2), np.array([3, 1, 5, 0, 4])  # the third has no pose
    odds = one.exchanged(given)
    for i, j in permutations(range(5), 2):
        other = given.copy()
        other[[i, j]] = other[[j, i]]
        gained = log_likelihood(one, other) - log_likelihood(one, given)
        assert odds[i, j] == pytest.approx(gained, abs=1e-9)


def test_exchanges_of_two_lead_to_the_likeliest_assignment() -> None:
    found = []
    for seed in range(12):
        one = drawn(seed)
        every = [log_likelihood(one, np.array(p)) for p in permutations(range(5))]
        found.append(max(every) - log_likelihood(one, one.best()))
    # of distances by chance, which bodies never have; the worst is an exchange of three
    assert np.median(found) == pytest.approx(0.0, abs=1e-9)
    assert np.mean(np.array(found) < 1e-9) >= 0.7


def test_changes_of_distance_are_learnt_where_both_bodies_are_seen() -> None:
    rules, places = MotionRules(), np.array([[0.0, 0, 0], [30.0, 0, 0], [0, 40.0, 0]])
    unknown = Distances.unknown(3, 25.0, rules)
    first = unknown.after(places, rules)
    np.testing.assert_allclose(first.last, [[0, 30, 40], [30, 0, 50], [40, 50, 0]])
    # nothing is known to have changed yet
    np.testing.assert_allclose(first[1:], unknown[1:])
    moved = places + np.array([[0, 0, 0], [6.0, 0, 0], [np.nan, 0, 0]])
    after, guess = first.after(moved, rules), rules.guess_weight
    assert after.squares[0, 1] == pytest.approx(rules.recall * guess * 25.0**2 + 6.0**2)
    assert after.numbers[0, 1] == pytest.approx(rules.recall * guess + 1)
    # of a body that is hidden the last distance is remembered, and how long ago that was
    assert (after.last[0, 2], after.numbers[0, 2], after.missed[0, 2]) == (40.0, guess, 1.0)
    back = after.after(places + np.array([[0.0, 0, 0], [6.0, 0, 0], [0, 8.0, 0]]), rules)
    assert back.squares[0, 2] == pytest.approx(rules.recall * guess * 25.0**2 + (8.0 / 2) ** 2)
    assert (back.missed == 0).all()


def test_bodies_that_move_together_farther_than_they_are_apart_keep_their_numbers() -> None:
    tool = body("tool", TOOL)
    scene = scene_of(tool, tool, tool)
    tracks, numbers = scene.begin(), []
    # a row of three, 160 apart, that jumps by about as much to and fro
    for frame, jump in enumerate([0.0, 10.0, 30.0, 20.0, 170.0, 60.0, 200.0, 40.0]):
        poses = [at(jump - 160.0), at(jump, 40.0), at(jump + 160.0, -60.0)]
        tracks, found = scene.advance(tracks, frame, None, views_of([tool] * 3, poses, frame))
        numbers.append([int(np.argmin([off(one, T)[0] for T in poses])) for one in found])
        assert all(off(one, poses[k])[0] < 2.0 for one, k in zip(found, numbers[-1], strict=True))
    assert numbers == [[0, 1, 2]] * 8


def test_a_body_that_comes_as_an_identical_one_goes_has_a_number_of_its_own() -> None:
    tool = body("tool", TOOL)
    scene = scene_of(*[tool] * 5)
    tracks, carried = scene.begin(), dict[int, int]()
    # a belt, 200 apart, on which one leaves the view on the right as another enters on the left
    for frame in range(12):
        row = {k: at(300 - 200 * k + 20 * frame) for k in range(5)}
        row = {k: T for k, T in row.items() if -310 < T[0, 3] < 310}
        views = views_of([tool] * len(row), [*row.values()], frame)
        tracks, found = scene.advance(tracks, frame, None, views)
        told = {one.instance: one for one in found if one.status == "ok"}
        now = {i: k for i, one in told.items() for k, T in row.items() if off(one, T)[0] < 2.0}
        assert len(now) == len(told) >= len(row) - 1
        assert all(carried.get(i, k) == k for i, k in now.items() if i is not None)
        carried |= {i: k for i, k in now.items() if i is not None}

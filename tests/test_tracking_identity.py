"""Which of identical bodies is which: by their motion, and by their distances to each other."""

from __future__ import annotations

from itertools import permutations
from math import log1p

import numpy as np
import pytest
from bodies_in_view import TOOL, at, body, off, scene_of, views_of

from mixpose.records import Indices
from mixpose.tracking.identity import Assignment, distances_after, no_distances
from mixpose.tracking.motion import MotionRules

DEGREES = 3.0


def drawn(seed: int, bodies: int = 5, poses: int = 5) -> Assignment:
    """Bodies that have poses, and distances, by chance; what is known of two of them is nothing."""
    rng = np.random.default_rng(seed)
    likely = np.column_stack([rng.normal(0.0, 6.0, (bodies, poses)), np.zeros(bodies)])
    places = np.concatenate([rng.uniform(0.0, 300.0, (poses, 3)), np.full((1, 3), np.nan)])
    before = rng.uniform(50.0, 300.0, (bodies, bodies))
    before = (before + before.T) / 2
    before[0, 1] = before[1, 0] = np.nan
    sums = np.array([before, np.full_like(before, 800.0), np.full_like(before, 2.0)])
    now = np.linalg.norm(places[:, None] - places, axis=2)
    return Assignment(likely, sums, now, DEGREES)


def log_likelihood(one: Assignment, given: Indices) -> float:
    """Written out: of each body its pose, of each pair of them the change of its distance."""
    total, (before, squares, count) = 0.0, one.before
    for i, p in enumerate(given):
        total += one.likely[i, p]
        for j in range(i):
            off = one.now[p, given[j]] - before[i, j]
            if np.isfinite(off):
                scaled = off**2 / (squares[i, j] / count[i, j])
                total -= 0.5 * (DEGREES + 1) * log1p(scaled / DEGREES)
    return total


@pytest.mark.parametrize("seed", range(4))
def test_the_odds_of_an_exchange_are_those_of_all_bodies_together(seed: int) -> None:
    one, given = drawn(seed), np.array([3, 1, 5, 0, 4])  # the third has no pose
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
    first = distances_after(no_distances(3, 25.0, rules), places, rules)
    np.testing.assert_allclose(first[0], [[0, 30, 40], [30, 0, 50], [40, 50, 0]])
    # nothing is known to have changed yet
    np.testing.assert_allclose(first[1:], no_distances(3, 25.0, rules)[1:])
    moved = places + np.array([[0, 0, 0], [6.0, 0, 0], [np.nan, 0, 0]])
    after = distances_after(first, moved, rules)
    guess = rules.guess_weight
    assert after[1, 0, 1] == pytest.approx(rules.recall * guess * 25.0**2 + 6.0**2)
    assert after[2, 0, 1] == pytest.approx(rules.recall * guess + 1)
    assert np.isnan(after[0, 0, 2])
    assert after[2, 0, 2] == guess


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

"""What bodies of a scene claim first, and what is kept of them that others have to leave first."""

from __future__ import annotations

import numpy as np
import pytest
from bodies_in_view import CAMERAS, at, body, off, scene_of, views_of

from mixpose.records import Floats
from mixpose.rigid import from_rotation_vector, transform
from mixpose.tracking.sharing import Sharing


def moving(seed: int, frame: int) -> list[Floats]:
    """Three bodies side by side; they are 60 frames farther once they come back."""
    time = frame if frame < 3 else frame + 60
    turns = [np.random.default_rng(1000 * seed + j).uniform(-1, 1, 3) for j in range(3)]
    return [
        from_rotation_vector(np.add(turn, [0, 0.02 * time, 0]), [x + time, -0.5 * time, 0])
        for turn, x in zip(turns, (-60, 0, 60), strict=True)
    ]


@pytest.mark.parametrize("seed", [1, 31, 52])
def test_bodies_that_points_show_without_being_sure_are_told_once_others_have_theirs(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    bodies = [body(name, rng.uniform(-30, 30, (3, 3))) for name in "abc"]
    scene = scene_of(*bodies)
    tracks = scene.begin()
    for frame in range(8):
        poses = moving(seed, frame)
        some = slice(None) if frame < 3 or frame == 7 else slice(0)
        views = views_of(bodies[some], poses[some], seed + frame)
        tracks, told = scene.advance(tracks, frame, frame / 10, views)
    # 70 mm from where they were before four frames without them: among nine markers no three are
    # one body's for certain, among three they are
    assert [one.status for one in told].count("lost") == 0
    assert max(off(one, T)[0] for one, T in zip(told, poses, strict=True)) < 1.5


def test_a_body_is_where_it_was_expected_though_a_third_of_it_is_hidden(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waiting: list[list[int]] = []

    def noted(_: Sharing, some: list[int]) -> None:
        waiting.append(some)

    rng = np.random.default_rng(2)
    bodies = [body(name, rng.uniform(-50, 50, (12, 3))) for name in "ab"]
    scene, name = scene_of(*bodies), "left"
    tracks = scene.begin()
    for frame in range(6):
        poses = [at(-100 + frame, turn=0.4), at(110, frame, turn=-0.8)]
        hidden = 4 if frame > 3 else 0
        shown = [body(one.name, one.means[hidden:]) for one in bodies]
        views = [view for view in views_of(shown, poses, frame) if view.name == name]
        assert views[0].observation.cells == 2 * (12 - hidden) + 1
        if frame == 5:  # what is not where it was expected would be looked for everywhere
            monkeypatch.setattr(Sharing, "_fit_unclaimed", noted)
        tracks, told = scene.advance(tracks, frame, frame / 10, views)
    assert waiting == [[], []]
    assert [one.status for one in told] == ["ok", "ok"]
    for one, each, T in zip(told, bodies, poses, strict=True):
        assert one.T_world_object is not None
        away = CAMERAS[name].project(transform(one.T_world_object, each.means))[0]
        there = CAMERAS[name].project(transform(T, each.means))[0]
        assert np.abs(away - there).max() < 1.0

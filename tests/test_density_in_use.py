"""What runs look up, and what pictures show, are densities drawn as images, through cv2.remap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mixpose
from mixpose.density import Atlas, observation
from mixpose.objective import View, project_body
from mixpose.pictures.stages import densities_picture
from mixpose.records import Estimate, FrameSet
from mixpose.runner import run
from mixpose.selection import Selection

Floats = NDArray[np.float64]

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RECORDINGS = ["two_cameras", "one_camera_video", "parallel_beams", "range_profiles"]
FRAMES = 4


@dataclass
class Spy:
    """Atlases that were drawn, and the places (L, H, n, 2) that cv2.remap looked up in them."""

    drawn: list[Atlas] = field(default_factory=list)
    places: list[tuple[Atlas, Floats]] = field(default_factory=list)

    def forget(self) -> None:
        self.drawn.clear()
        self.places.clear()

    def places_in(self, atlas: Atlas) -> list[Floats]:
        return [y for one, y in self.places if one is atlas]


@pytest.fixture
def spy(monkeypatch: pytest.MonkeyPatch) -> Spy:
    found = Spy()
    remapped: list[Any] = []
    remap, look_up = cv2.remap, Atlas.look_up

    def recorded(values: Any, *others: Any, **named: Any) -> Any:
        remapped.append(values)
        return remap(values, *others, **named)

    def looked_up(self: Atlas, y: Floats) -> Floats:
        remapped.clear()
        sampled = look_up(self, y)
        assert len(remapped) == 1
        assert remapped[0] is self.values
        found.places.append((self, y.copy()))
        return sampled

    def drawn(*arguments: Any, **named: Any) -> Atlas:
        atlas = Atlas(*arguments, **named)
        found.drawn.append(atlas)
        return atlas

    monkeypatch.setattr("mixpose.density.atlas.cv2.remap", recorded)
    monkeypatch.setattr(Atlas, "look_up", looked_up)
    monkeypatch.setattr(observation, "Atlas", drawn)
    return found


def predicted(views: Sequence[View], body: mixpose.Body, T: Floats) -> Floats:
    """Places (L, 1, n, 2) of the body's features at a pose."""
    return project_body(tuple(view.sensor for view in views), body).project(T[None]).y


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_pose_is_looked_up_in_drawn_densities_by_remap(name: str, spy: Spy) -> None:
    session = mixpose.load_session(SYNTHETIC / name / "session.toml")
    assert session.estimator.objective == "matched"  # as by default
    looked_up = []

    def watch(frame: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        assert estimate.T_world_object is not None
        at_pose, around = 0, 0
        y = predicted(views, session.body, estimate.T_world_object)
        for atlas in spy.drawn:
            if len(atlas.per_unit) == len(views):
                places = spy.places_in(atlas)
                around += len(places)
                # but for rounding: it was estimated of the middle of the body
                same = [one.shape == y.shape and np.abs(one - y).max() < 1e-8 for one in places]
                at_pose += sum(same)
        looked_up.append((at_pose, around))
        spy.forget()

    estimates = list(run(session, selection=Selection(0, FRAMES), watch=watch))
    assert [one.status for one in estimates] == ["ok"] * FRAMES
    # of each frame: where its pose puts the features, once at least, and on the way to it
    assert len(looked_up) == FRAMES
    for at_pose, around in looked_up:
        assert at_pose >= 1
        assert around >= 3


@pytest.mark.parametrize("name", ["two_cameras", "one_camera_video", "parallel_beams"])
def test_pictures_of_densities_show_what_the_estimate_looked_up(name: str, spy: Spy) -> None:
    session = mixpose.load_session(SYNTHETIC / name / "session.toml")
    seen: list[tuple[list[View], Floats, list[Atlas]]] = []

    def watch(frame: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        assert estimate.T_world_object is not None
        seen.append((list(views), estimate.T_world_object, list(spy.drawn)))

    list(run(session, selection=Selection(0, 1), watch=watch))
    ((views, T, drawn),) = seen
    for k, view in enumerate(views):
        y = predicted(views, session.body, T)
        spy.forget()
        sigma = view.observation.sigma
        densities_picture(view, session.body, T, [sigma], session.estimator, (400, 300))
        (shown,) = spy.drawn
        assert isinstance(shown, Atlas)
        assert spy.places_in(shown), "what is shown is looked up, too"
        # those of the estimate that are as fine
        alike = [
            atlas
            for atlas in drawn
            if len(atlas.per_unit) == len(views)
            and np.array_equal(atlas.per_unit[k], shown.per_unit[0])
        ]
        assert alike
        expected = alike[-1].look_up(y)[k]
        values = shown.look_up(y[k : k + 1])[0]
        assert values[..., 0].max() > 0
        # single precision: of places of up to 40 cells, and of products of three numbers
        np.testing.assert_allclose(values, expected, rtol=2e-5, atol=2e-5 * expected.max())

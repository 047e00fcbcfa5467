"""Bodies of which one is a part of another: which of them is seen, from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from bodies_in_view import TOOL, at, body, off, scene_of, views_of

from mixpose.body import Body
from mixpose.records import Estimate
from mixpose.tracking import Track

WHOLE, PART = body("whole", TOOL), body("part", TOOL[:4])


def advanced(session: Sequence[Body], seen: Sequence[Body]) -> list[list[Estimate]]:
    """Estimates of frames in which one body moves, of which something is seen."""
    scene = scene_of(*session)
    tracks: Sequence[Track] = scene.begin()
    found = []
    for frame, one in enumerate(seen):
        views = views_of([one], [at(-60 + 4 * frame, turn=0.05 * frame)], frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        found.append(estimates)
    return found


@pytest.mark.parametrize("seen", [4, 3])
def test_a_body_of_which_markers_are_hidden_is_not_taken_for_one_that_has_the_others(
    seen: int,
) -> None:
    part = body("part", TOOL[:seen])
    whole = body("whole", TOOL[: seen + 1])
    found = advanced([whole, part], [whole] * 4 + [part] * 8)
    # where it was seen whole there is no doubt which of the two it is
    assert [[one.status for one in estimates] for estimates in found] == [["ok", "lost"]] * 12
    assert off(found[-1][0], at(-60 + 4 * 11, turn=0.55))[0] < 2.0


def test_a_body_that_may_be_a_part_of_another_is_in_doubt_for_as_long_as_nothing_tells() -> None:
    found = advanced([WHOLE, PART], [PART] * 12)
    # one marker is hidden as often in twelve frames as in one
    assert [estimates[1].status for estimates in found] == ["ambiguous"] * 12
    assert {estimates[1].doubt for estimates in found} == {
        "what is met lies like features of 'whole'"
    }
    # seen whole it is the other one
    assert [one.status for one in advanced([WHOLE, PART], [PART] * 3 + [WHOLE])[-1]] == [
        "ok",
        "lost",
    ]

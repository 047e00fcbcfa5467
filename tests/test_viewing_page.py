"""What the page of a run shows: drawn from poses that are known, without a run."""

from __future__ import annotations

import http.cookiejar
import tracemalloc
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_runs import RECORDING, SYNTHETIC, estimate

from mixpose import rigid
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, Floats, PointPattern, RawFrame
from mixpose.sensors import CloudSensor
from mixpose.session import Session, load_session

pytest.importorskip("viser")

from page_client import open_page
from websockets.exceptions import InvalidStatus

from mixpose.viewing.address import listen
from mixpose.viewing.moment import PACE, Moment, ShownFrame, row_of
from mixpose.viewing.page import Page, status_text
from mixpose.viewing.scene import outlines_of, up_of
from mixpose.viewing.server import started


def truth() -> list[Floats]:
    poses = [line.T_world_object for line in read_poses(RECORDING / "truth.jsonl").poses]
    return [T for T in poses if T is not None]


TRUTH = truth()


@pytest.fixture
def session() -> Session:
    """Two cameras, with images so small that drawing takes little time."""
    session = load_session(RECORDING / "session.toml")
    return replace(
        session, sensors=tuple(replace(one, resolution=(64, 48)) for one in session.sensors)
    )


@pytest.fixture
def server() -> Iterator[Any]:
    place = listen("0")
    with started(place, on_viewers=lambda count: None) as server:
        yield server
    place.socket.close()


def moment(frame: int, *estimates: Estimate) -> Moment:
    pattern = PointPattern(np.array([[30.0, 20.0]]), np.ones(1))
    seen = ShownFrame(RawFrame(frame, None, pattern), features=pattern.points)
    counts = Counter(one.status for one in estimates)
    return Moment(estimates, {"left": seen, "right": seen}, (row_of(estimates),), counts)


def buffered(server: Any) -> list[Any]:
    """What a browser that opens the page now is told."""
    return list(server._websock_server.get_message_buffer().message_from_id.values())


def test_what_the_page_keeps_does_not_grow_with_the_frames(server: Any, session: Session) -> None:
    page = Page(server, session, None)
    one = estimate(0, TRUTH[0])
    long_ago = tuple(replace(row_of((one,)), frame=k) for k in range(-PACE.history, 0))
    page.show(replace(moment(0, one), rows=long_ago))  # plots and trails are full
    tracemalloc.start()
    try:
        remembered, told = [], []
        for begin in (1, 6, 16):
            for frame in range(begin, begin + 5 if begin == 1 else begin + 10):
                page.show(moment(frame, estimate(frame, TRUTH[frame])))
            remembered.append(tracemalloc.get_traced_memory()[0])
            told.append(len(buffered(server)))
    finally:
        tracemalloc.stop()
    assert told[0] == told[1] == told[2]
    # one row of a plot takes some 500 bytes, one picture of 64 x 48 pixels 9000
    assert remembered[2] - remembered[1] < 10 * 5000


def test_the_body_and_its_ellipsoid_are_where_the_pose_has_them(
    server: Any, session: Session
) -> None:
    page = Page(server, session, None)
    page.show(moment(0, estimate(0, TRUTH[0])))
    scene = page._scene
    one = estimate(1, TRUTH[1])
    assert one.covariance is not None
    page.show(moment(1, one))
    (nodes,) = scene._nodes
    np.testing.assert_allclose(nodes.pose.position, scene._scale * TRUTH[1][:3, 3], rtol=1e-6)
    turn = np.roll(rigid.quaternion_xyzw(TRUTH[1]), 1)
    assert abs(nodes.pose.wxyz @ turn) == pytest.approx(1.0)
    # standard deviations are 0.02, 0.02 and 0.03 mm, and 7.815 is the 95 % of chi2 of three
    deviations = np.sort(nodes.ellipsoid.scale) / (scene._scale * scene.magnification)
    np.testing.assert_allclose(deviations, np.sqrt(7.815) * np.array([0.02, 0.02, 0.03]))
    np.testing.assert_allclose(
        nodes.trail.points, scene._scale * np.array([[TRUTH[0][:3, 3], TRUTH[1][:3, 3]]]), rtol=1e-6
    )


def test_an_ellipsoid_too_small_to_see_is_enlarged_and_the_page_says_so(
    server: Any, session: Session
) -> None:
    page = Page(server, session, None)
    page.show(moment(0, estimate(0, TRUTH[0])))
    # 0.084 mm against a tenth of the radius of the body, 8 mm or so: x 100
    largest = np.sqrt(7.815) * 0.03
    enough = 0.1 * session.body.radius / largest
    assert page._magnified.value == f"× {10 ** int(np.ceil(np.log10(enough)))}"


def test_a_lost_body_is_hidden_and_breaks_its_trail(server: Any, session: Session) -> None:
    page = Page(server, session, None)
    for frame, status in enumerate(("ok", "lost", "ok", "ok")):
        page.show(moment(frame, estimate(frame, TRUTH[frame], status)))  # type: ignore[arg-type]
        (nodes,) = page._scene._nodes
        assert nodes.pose.visible == nodes.ellipsoid.visible == (status != "lost")
    assert len(nodes.trail.points) == 1  # of three gaps between frames


def test_first_frames_without_a_pose_show_the_sensors(server: Any, session: Session) -> None:
    page = Page(server, session, None)
    page.show(moment(0, estimate(0, TRUTH[0], "lost")))
    assert page._scene._scale > 0
    page.show(moment(1, estimate(1, TRUTH[1])))
    assert page._scene._nodes[0].pose.visible


def test_names_of_a_session_are_only_ever_words_on_the_page() -> None:
    evil = "<img src=x onerror=alert(1)>"
    text = status_text(moment(0, estimate(0, TRUTH[0], object=evil)))
    assert evil not in text
    assert "&lt;img src=x onerror=alert(1)&gt;" in text


def test_no_browser_can_have_the_page_opened_to_the_outside(server: Any) -> None:
    # what viser does for its button "share", which its server takes from anybody
    assert server.request_share_url() is None
    assert server._share_tunnel is None


def test_a_page_open_to_others_is_shown_to_those_with_the_token_only() -> None:
    place = replace(listen("0"), token="right")
    with started(place, on_viewers=lambda count: None):
        bare = f"http://127.0.0.1:{place.port}/"
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(bare)
        with pytest.raises(InvalidStatus, match="403"):
            open_page(bare)
        cookies = http.cookiejar.CookieJar()
        browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(cookies))
        with browser.open(f"{bare}?token=right") as page:
            assert page.url == bare  # the token is no longer in the address
            assert b"Viser" in page.read()
        cookie = "; ".join(f"{one.name}={one.value}" for one in cookies)
        open_page(bare, additional_headers={"Cookie": cookie}).close()
    place.socket.close()


def test_a_page_of_another_site_cannot_look_nor_click() -> None:
    place = listen("0")
    with started(place, on_viewers=lambda count: None):
        with pytest.raises(InvalidStatus, match="403"):
            open_page(place.address, origin="http://evil.example")
        asked = urllib.request.Request(place.address, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(asked)
        open_page(place.address, origin=place.address.rstrip("/")).close()
    place.socket.close()


@pytest.mark.parametrize(
    "path", sorted(SYNTHETIC.glob("*/session.toml")), ids=lambda p: p.parent.name
)
def test_cameras_see_what_their_outlines_enclose(path: Path) -> None:
    session = load_session(path)
    outlines = outlines_of(session, {})
    assert [one.name for one in outlines] == [one.name for one in session.sensors]
    for outline, setup in zip(outlines, session.sensors, strict=True):
        if outline.border is None:
            assert setup.sensor.dimension == 1
            continue
        lines = outline.segments(1000.0)
        assert np.isfinite(lines).all()
        far = outline.border.origins + 500.0 * outline.border.directions
        y, seen = setup.sensor.project(far)
        assert seen.all()
        # along the edge of the image, whose corners are half a pixel beyond the outer pixels
        lower, upper = setup.sensor.lower, setup.sensor.upper
        edge = np.minimum(np.abs(y - lower), np.abs(y - upper)).min(axis=1)
        assert edge.max() < 0.05 * (upper - lower).max()


def test_up_is_up_in_the_images() -> None:
    # two cameras that stand upright in the world's x-z plane look along z: y is down
    session = load_session(RECORDING / "session.toml")
    np.testing.assert_allclose(up_of(session), [0.0, -1.0, 0.0], atol=1e-12)
    upside_down = rigid.from_rotation_vector([0, 0, np.pi], [0, 0, 0])
    turned = tuple(replace(one, sensor=one.sensor.moved(upside_down)) for one in session.sensors)
    np.testing.assert_allclose(up_of(replace(session, sensors=turned)), [0.0, 1.0, 0.0], atol=1e-9)
    cloud = replace(session.sensors[0], sensor=CloudSensor(np.eye(4)))
    for sensors in ((), (cloud,)):  # which have no image
        assert up_of(replace(session, sensors=sensors)).tolist() == [0.0, 0.0, 1.0]

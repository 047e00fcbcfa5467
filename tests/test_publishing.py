"""What is published: addresses, what waits, stamps, poses ahead; and what is refused."""

from __future__ import annotations

import json
import socket
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import lines_of
from published_pose import ESTIMATE, HEADER, POSE

from mixpose.cli import main
from mixpose.errors import SessionError
from mixpose.publishing import Publishing
from mixpose.publishing.channel import Backlog
from mixpose.publishing.message import Message, parse
from mixpose.records import Estimate, Hypothesis, MeasuredPoint, Moment
from mixpose.rigid import perturb, twist_between
from mixpose.session import load_session
from mixpose.simulation.motion import plan_motion
from mixpose.tracking import PosePredictor

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
SESSION = SYNTHETIC / "two_cameras" / "session.toml"


def run(*arguments: str) -> None:
    with pytest.raises(SystemExit) as left:
        main(["run", *arguments])
    assert left.value.code == 0


def refusal(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as left:
        main(["run", str(SESSION), *arguments])
    assert left.value.code == 2
    out, err = capfd.readouterr()
    assert not out
    assert len(err.splitlines()) == 1
    return err


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("http://there", "allowed: udp://, tcp://, ws://, osc://, lsl://, mqtt://, ros2://"),
        ("9870", "no address of a receiver; allowed: udp://"),
        ("udp://there", "found no host and port; allowed: udp://127.0.0.1:9870"),
        ("udp://a:9870/tool", "found 'tool' behind host and port; allowed: udp://127.0.0.1:9870"),
        ("tcp://there:99999", "is no address: Port out of range"),
        ("udp://a..b:90", "host: found 'a..b'; allowed: a number, or words with a dot between"),
        ("mqtt://.there", "host: found '.there'; allowed"),
        ("ros2://tool?bridge=a..b:9090", "host: found 'a..b'; allowed"),
        ("tcp://there:9870?only=good", "only: found good; allowed: ok"),
        ("tcp://there:9870?only=", "only: found ; allowed: ok"),
        ("osc://there:9870?rate=3", "option: found rate; allowed: only"),
        ("osc://there:9870/a*", "found '*' in the path; allowed: printable ASCII but for space"),
        ("lsl://", "found no name; allowed: lsl://tracker"),
        ("ros2://my body", "topic: found my body; allowed: words of letters"),
        ("ros2://tool?bridge=there", "bridge: found there; allowed: host:port"),
        ("mqtt://there/rig/+", "topic: found + or #, which name many; allowed: a topic without"),
        ("mqtt://there/rig/#", "topic: found + or #"),
    ],
)
def test_address_that_nothing_can_be_sent_to_is_refused_before_the_run(
    url: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    err = refusal(["--publish", url], capfd)
    assert err.startswith(f"mixpose: --publish {url}: ")
    assert words in err


def test_protocol_whose_package_is_not_there_names_its_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mixpose.errors.find_spec", lambda _: None)
    needed = {"ws": "ws", "osc": "osc", "lsl": "lsl", "mqtt": "mqtt", "ros2": "ros2"}
    for scheme, extra in needed.items():
        with pytest.raises(SessionError, match=rf"pip install 'mixpose\[{extra}\]'"):
            Publishing([f"{scheme}://there:1/place"], HEADER, print)
    Publishing(["udp://127.0.0.1:9", "tcp://127.0.0.1:9"], HEADER, print)


def test_password_that_is_not_quoted_is_not_said_where_the_address_is_refused(
    capfd: pytest.CaptureFixture[str],
) -> None:
    err = refusal(["--publish", "mqtt://me:se/cr@et@host/rig"], capfd)
    assert "--publish mqtt://host/rig: is no address: of a user name or password / ? #" in err
    assert all(part not in err for part in ("me:", "se/", "'se'", "cr@", "et@"))


def test_password_of_a_broker_is_not_said() -> None:
    parsed = parse("mqtt://me:s%2Fecret@host:1884/rig/one?only=ok")
    assert (parsed.user, parsed.password) == ("me", "s/ecret")
    assert parsed.text == "mqtt://host:1884/rig/one?only=ok"
    assert (parsed.place(""), parsed.path) == (("host", 1884), "rig/one")


def test_port_that_is_taken_cannot_be_listened_at(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        url = f"ws://127.0.0.1:{taken.getsockname()[1]}"
        assert "cannot be listened at: Address already in use" in refusal(["--publish", url], capfd)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--predict", "0.02"], "--predict: found no --publish"),
        (["--publish", "udp://127.0.0.1:9", "--predict", "-1"], "found -1; allowed: seconds above"),
        (["--publish", "udp://127.0.0.1:9", "--predict", "nan"], "--predict: found nan; allowed"),
        ([str(SESSION), "--publish", "udp://127.0.0.1:9"], "--publish: found several sessions"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    arguments: list[str], words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert words in refusal(arguments, capfd)


def test_receiver_that_is_not_there_neither_ends_nor_changes_a_run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "poses.jsonl"
    common = [str(SESSION), "--stop", "4"]
    run(*common, "--publish", "tcp://127.0.0.1:9", "-o", str(output))
    err = capfd.readouterr().err
    assert "warning: --publish tcp://127.0.0.1:9: the receiver is away: Connection refused" in err
    assert "published to tcp://127.0.0.1:9: 0 poses, 4 dropped: " in err
    assert "4 frames: 4 ok" in err
    run(*common)
    poses = [lines_of(capfd.readouterr().out), lines_of(output.read_text())]
    for line in (one for lines in poses for one in lines):
        line.pop("latency_ms", None)
    assert poses[0] == poses[1]


def test_poses_ahead_are_published_and_those_of_the_frames_written(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = (SYNTHETIC / "one_camera_video" / "session.toml").read_text()
    session = tmp_path / "session.toml"
    session.write_text(text.replace('"camera.avi"', f'"{SYNTHETIC}/one_camera_video/camera.avi"'))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        receiving.bind(("127.0.0.1", 0))
        url = f"udp://127.0.0.1:{receiving.getsockname()[1]}"
        run(str(session), "--stop", "6", "--publish", url, "--predict", "0.04")
        header, *found = [json.loads(receiving.recv(65536)) for _ in range(7)]
    written = lines_of(capfd.readouterr().out)
    assert header == written[0]
    for line, pose in zip(found, written[1:], strict=True):
        assert line["ahead_s"] == 0.04
        assert line["time_s"] == pose["time_s"] + 0.04
        grown = np.diagonal(line["covariance"]) / np.diagonal(pose["covariance"])
        assert (grown > 1).all()
    # frames are 0.04 s apart: it is foretold where the next one finds it, nearer than it was
    ahead, there = np.array(found[4]["T_world_object"]), np.array(written[6]["T_world_object"])
    was = np.array(written[5]["T_world_object"])
    assert np.linalg.norm((ahead - there)[:3, 3]) < 0.3 * np.linalg.norm((was - there)[:3, 3])


def test_pose_ahead_of_a_frame_without_a_time_is_refused() -> None:
    known = PosePredictor(load_session(SESSION).body)
    with pytest.raises(SessionError, match=r"^--predict: frame 7 has no time; add fps to"):
        known.after(replace(ESTIMATE, time_s=None))


@pytest.mark.parametrize(
    ("fps", "ahead_s", "noise", "tremor"),
    # 1.6 of a hand that trembles, where of the filters only the likeliest one is believed
    [(100, 0.02, 0.01, 0.0), (30, 0.05, 0.3, 0.0), (200, 0.02, 0.1, 0.07)],
)
def test_poses_ahead_err_by_what_their_covariance_says(
    fps: int, ahead_s: float, noise: float, tremor: float
) -> None:
    body = load_session(SESSION).body
    deviations = np.repeat([noise, noise / body.radius], 3)
    squares, errors, still = [], [], []
    for seed in range(3):
        motion = plan_motion(
            np.eye(4), np.zeros(3), translation=100, rotation_deg=30, period_s=2.0, seed=seed
        )
        rng, known = np.random.default_rng(seed), PosePredictor(body)
        phases, times = np.random.default_rng(seed + 100).random(6), np.arange(2 * fps) / fps
        shakes, moments = tremor / noise * deviations, (times, times + ahead_s)
        truth, later = (
            perturb(motion.poses(t), shakes * np.sin(2 * np.pi * (10 * t[:, None] + phases)))
            for t in moments
        )
        for k in range(2 * fps):
            T = perturb(truth[k], deviations * rng.standard_normal(6))
            covariance = np.diag(deviations**2)
            estimate = Estimate(k, k / fps, "tool", "ok", T, covariance, 1.0, {})
            known = known.after(estimate)
            ahead = known.ahead(estimate, ahead_s)
            assert ahead.T_world_object is not None
            assert ahead.covariance is not None
            if k < fps // 3:  # before that the motion is not known
                continue
            off = twist_between(ahead.T_world_object, later[k])
            squares.append(off @ np.linalg.solve(ahead.covariance, off) / 6)
            errors.append(off[:3])
            still.append(twist_between(T, later[k])[:3])
    # 1 is right; of 6 x 300 errors that go together over some ten frames, by 10 % more or less
    assert 0.8 < np.mean(squares) < 1.25
    assert np.mean(np.square(errors)) < 0.04 * np.mean(np.square(still))


def test_lost_frames_stay_lost_and_hypotheses_are_not_foretold() -> None:
    body = load_session(SESSION).body
    known = PosePredictor(body).after(ESTIMATE)
    lost = replace(ESTIMATE, status="lost", T_world_object=None, covariance=None)
    assert known.after(lost) == known
    assert known.ahead(lost, 0.02).T_world_object is None
    doubtful = replace(ESTIMATE, status="ambiguous", hypotheses=(Hypothesis(POSE, 1.0),))
    assert known.ahead(doubtful, 0.02).hypotheses == ()
    # features were measured where they were then
    seen = replace(ESTIMATE, points={"1": MeasuredPoint(np.zeros(3), 0.1)})
    assert known.ahead(seen, 0.02).points == {}


def test_direction_that_is_not_estimated_is_not_foretold_to_move() -> None:
    body = load_session(SESSION).body
    covariance = np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    known = PosePredictor(body)
    for k in range(5):
        T = perturb(POSE, np.array([k, 0, 0, 0, 0, 0.01 * k]))
        estimate = Estimate(k, 0.1 * k, "tool", "ok", T, covariance, 1.0, {})
        known = known.after(estimate)
    ahead = known.ahead(estimate, 0.1)
    assert ahead.covariance is not None
    assert ahead.T_world_object is not None
    assert not ahead.covariance[2:5].any()
    moved = twist_between(T, ahead.T_world_object)
    np.testing.assert_allclose(moved[2:5], 0, atol=1e-12)
    assert moved[0] > 0.5  # 1 in each 0.1 s


def test_too_much_that_waits_loses_its_oldest() -> None:
    backlog, messages = Backlog(3), [Message(replace(ESTIMATE, frame=k)) for k in range(5)]
    for one in messages:
        backlog.put(one)
    assert backlog.dropped == 2
    first = backlog.take()
    assert first is messages[2]
    backlog.put_back(messages[2])  # as where the receiver went away
    assert [backlog.take() for _ in range(3)] == messages[2:]
    for one in messages[:4]:
        backlog.put(one)
    backlog.put_back(messages[4])  # no room: newer ones are there
    assert backlog.dropped == 4
    backlog.end()
    assert [backlog.take() for _ in range(4)] == [*messages[1:4], None]


def test_stamp_of_a_pose_ahead_is_of_the_moment_that_it_is_for() -> None:
    moment, now = Moment(time.monotonic() - 0.5, "capture"), time.time()
    line = json.loads(Message(ESTIMATE, moment, 0.02).text)
    # of the frame, half a second ago; the clocks are read one after the other
    frame = json.loads(Message(ESTIMATE, moment).text)["stamp_s"]
    assert now - 0.5 == pytest.approx(frame, abs=0.4)
    assert line["stamp_s"] - frame == pytest.approx(0.02, abs=0.005)
    assert (line["stamp_of"], line["ahead_s"]) == ("capture", 0.02)
    recorded = json.loads(Message(ESTIMATE).text)
    assert not {"stamp_s", "stamp_of", "ahead_s"} & set(recorded)


def test_only_ok_leaves_out_the_others() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        receiving.bind(("127.0.0.1", 0))
        url = f"udp://127.0.0.1:{receiving.getsockname()[1]}?only=ok"
        said: list[str] = []
        with Publishing([url], HEADER, said.append) as publishing:
            for status in ("ambiguous", "ok"):
                frame_set: Any = type("FrameSet", (), {"moment": None})
                publishing.watch(frame_set, (), replace(ESTIMATE, status=status))
        assert [json.loads(receiving.recv(65536))["type"] for _ in range(2)] == ["header", "pose"]
    assert said == [f"published to {url}: 1 pose"]

"""What is published: addresses, what waits, stamps, poses ahead; and what is refused."""

from __future__ import annotations

import json
import socket
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from command_line import lines_of, wait_until

from mixpose.cli import main
from mixpose.errors import SessionError
from mixpose.poses.header import Header
from mixpose.publishing import SENDERS, Publishing, address
from mixpose.publishing.address import parse
from mixpose.publishing.channel import Backlog, PublishingRules
from mixpose.publishing.lsl import LslSender
from mixpose.publishing.message import Message
from mixpose.publishing.mqtt import MqttSender
from mixpose.publishing.ros2 import RosNodeSender, ros_messages, topics
from mixpose.publishing.sockets import OscSender
from mixpose.publishing.ws import WebSocketSender
from mixpose.records import Estimate, Hypothesis, Moment
from mixpose.rigid import from_rotation_vector, perturb, twist_between
from mixpose.session import load_session
from mixpose.simulation.motion import plan_motion
from mixpose.tracking import Foreseen

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
SESSION = SYNTHETIC / "two_cameras" / "session.toml"
HEADER = Header("mm", None, None, "0", 0, objects={"tool": 1})
POSE = from_rotation_vector([0.1, 0.2, 0.3], [10.0, 20.0, 30.0])
ESTIMATE = Estimate(7, 0.25, "tool", "ok", POSE, np.diag(np.arange(1.0, 7.0)), 0.9, {})


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
        ("osc://there:9870?rate=3", "option: found rate; allowed: only"),
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
    monkeypatch.setattr(address, "find_spec", lambda _: None)
    needed = {"ws": "ws", "osc": "osc", "lsl": "lsl", "mqtt": "mqtt", "ros2": "ros2"}
    for scheme, extra in needed.items():
        with pytest.raises(SessionError, match=rf"pip install 'mixpose\[{extra}\]'"):
            Publishing([f"{scheme}://there:1/place"], HEADER, print)
    Publishing(["udp://127.0.0.1:9", "tcp://127.0.0.1:9"], HEADER, print)


def test_password_of_a_broker_is_not_said() -> None:
    parsed = parse("mqtt://me:s%2Fecret@host:1884/rig/one?only=ok", SENDERS)
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
    known = Foreseen(load_session(SESSION).body)
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
        rng, known = np.random.default_rng(seed), Foreseen(body)
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
    known = Foreseen(body).after(ESTIMATE)
    lost = replace(ESTIMATE, status="lost", T_world_object=None, covariance=None)
    assert known.after(lost) == known
    assert known.ahead(lost, 0.02).T_world_object is None
    doubtful = replace(ESTIMATE, status="ambiguous", hypotheses=(Hypothesis(POSE, 1.0),))
    assert known.ahead(doubtful, 0.02).hypotheses == ()


def test_direction_that_is_not_estimated_is_not_foretold_to_move() -> None:
    body = load_session(SESSION).body
    covariance = np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    known = Foreseen(body)
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


def test_pages_count_as_receivers_from_when_one_is_there() -> None:
    client = pytest.importorskip("websockets.sync.client")
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"ws://127.0.0.1:{free.getsockname()[1]}/poses"
    sender = WebSocketSender(parse(url, SENDERS), HEADER)
    try:
        assert not sender.send(Message(ESTIMATE))  # nobody has got it, so it is not counted
        with client.connect(url) as page:
            assert json.loads(page.recv())["unit"] == "mm"
            heard: list[bool] = []

            def arrives() -> bool:
                heard.append(sender.send(Message(ESTIMATE)))
                with suppress(TimeoutError):
                    return bool(json.loads(page.recv(0.1))["frame"] == 7)
                return False

            wait_until(arrives)
            assert heard[-1]
    finally:
        sender.close()


def test_who_connects_and_speaks_no_http_is_not_worth_a_word(
    caplog: pytest.LogCaptureFixture,
) -> None:
    pytest.importorskip("websockets")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    sender = WebSocketSender(parse(f"ws://127.0.0.1:{port}", SENDERS), HEADER)
    try:
        with socket.create_connection(("127.0.0.1", port)) as stranger:
            stranger.sendall(b"GET /a b HTTP/1.1\r\n\r\n")
            while stranger.recv(1024):
                pass
    finally:
        sender.close()
    assert not caplog.records


def test_a_message_of_open_sound_control_counts_as_sent_and_names_its_body() -> None:
    parsing = pytest.importorskip("pythonosc.osc_message")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        receiving.bind(("127.0.0.1", 0))
        url = f"osc://127.0.0.1:{receiving.getsockname()[1]}/rig"
        sender = OscSender(parse(url, SENDERS), HEADER)
        sender.connect()
        assert sender.send(Message(ESTIMATE))
        sender.close()
        message = parsing.OscMessage(receiving.recv(65536))
    assert message.address == "/rig/tool"
    frame, time_s, status, *pose = message.params
    assert (frame, time_s, status) == (7, 0.25, "ok")
    np.testing.assert_allclose(pose[:3], [10, 20, 30], rtol=1e-6)  # single precision
    assert len(pose) == 7


@pytest.fixture
def broker(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Stands for the client of a broker that takes what comes."""
    module = MagicMock()
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", module)
    monkeypatch.setitem(sys.modules, "paho.mqtt.enums", MagicMock())
    monkeypatch.setattr(address, "find_spec", lambda _: True)
    client: MagicMock = module.Client.return_value
    client.publish.return_value = MagicMock(rc=0)
    client.loop_start.side_effect = lambda: client.on_connect(
        None, None, None, MagicMock(is_failure=False), None
    )
    return client


def test_a_broker_is_looked_for_at_the_port_of_its_protocol(broker: MagicMock) -> None:
    sender = MqttSender(parse("mqtt://there/rig", SENDERS), HEADER)
    sender.connect()
    broker.connect.assert_called_once_with("there", 1883)
    assert sender.send(Message(ESTIMATE))
    assert [call.args[0] for call in broker.publish.call_args_list] == ["rig/header", "rig/tool"]
    # gone while the message was on its way
    broker.publish.return_value.is_published.return_value = False
    broker.is_connected.return_value = False
    with pytest.raises(ConnectionError, match="the broker has gone"):
        sender.send(Message(ESTIMATE))


def test_a_body_that_is_called_header_does_not_replace_that_of_the_run(broker: MagicMock) -> None:
    sender = MqttSender(parse("mqtt://there/rig", SENDERS), replace(HEADER, objects={"header": 1}))
    sender.connect()
    assert sender.send(Message(replace(ESTIMATE, object="header")))
    topics = [call.args[0] for call in broker.publish.call_args_list]
    assert topics == ["rig/header", "rig/header_2"]


def test_a_broker_that_refuses_or_is_silent_is_away(
    broker: MagicMock, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender = MqttSender(parse("mqtt://there:9/rig", SENDERS), HEADER)
    refusal = MagicMock(is_failure=True, __str__=lambda _: "Not authorized")
    broker.loop_start.side_effect = lambda: broker.on_connect(None, None, None, refusal, None)
    with pytest.raises(ConnectionError, match="Not authorized"):
        sender.connect()
    broker.loop_start.side_effect = None
    monkeypatch.setattr(PublishingRules, "connect_s", 0.01)
    with pytest.raises(TimeoutError, match="the broker does not answer"):
        sender.connect()
    broker.publish.assert_not_called()


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


def test_several_bodies_have_topics_of_their_own() -> None:
    header = replace(HEADER, objects={"left hand": 1, "cup": 2, "\u5de6": 1, "\u53f3": 1})
    found = topics(parse("ros2://rig/poses", SENDERS), header)
    # of names that no topic can have no two become one
    words = ["left_hand", "cup_0", "cup_1", "_", "__2"]
    assert list(found.poses.values()) == [f"/rig/poses/{word}" for word in words]
    assert list(found.frames.values()) == words
    lost = replace(ESTIMATE, status="lost", T_world_object=None, covariance=None)
    assert ros_messages(Message(lost), found) == []


def test_the_stream_of_a_lost_frame_has_no_numbers_for_a_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pylsl = MagicMock()
    pylsl.local_clock.return_value = 50.0
    monkeypatch.setitem(sys.modules, "pylsl", pylsl)
    monkeypatch.setattr(address, "find_spec", lambda _: True)
    sender = LslSender(parse("lsl://rig", SENDERS), HEADER)
    _, _, channels, *_ = pylsl.StreamInfo.call_args.args
    lost = replace(ESTIMATE, status="lost", T_world_object=None, covariance=None)
    for estimate, status in ((lost, 0.0), (ESTIMATE, 2.0)):
        sender.send(Message(estimate))
        sample, stamp = pylsl.StreamOutlet.return_value.push_sample.call_args.args
        assert len(sample) == channels == 9
        assert sample[7:] == [status, 7.0]
        assert np.isnan(sample[:7]).all() == (status == 0.0)
        assert stamp == 50.0  # nothing is known of when the frame was taken


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


class Ros:
    """Stands for rclpy: keeps what is published."""

    def __init__(self) -> None:
        self.published: list[tuple[str, Any]] = []

    def __getattr__(self, _: str) -> Any:
        return lambda *__, **___: self

    def create_publisher(self, kind: Any, topic: str, _: int) -> Any:
        ros = self

        class Publisher:
            def publish(self, message: Any) -> None:
                assert type(message).__name__ == kind.__name__
                ros.published.append((topic, message))

            def get_subscription_count(self) -> int:
                return 1

        return Publisher()


def test_node_of_ros_publishes_a_pose_and_its_transform(monkeypatch: pytest.MonkeyPatch) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store, ros = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), Ros()

    def filled(name: str) -> Any:
        """A message of ROS with nothing in it, as its constructor makes it."""
        message: Any = type(name.rsplit("/", maxsplit=1)[-1], (), {})()
        for field, (sort, of) in store.fielddefs[name][1]:
            setattr(message, field, filled(of) if sort == typesys.base.Nodetype.NAME else None)
        return message

    def module(name: str) -> Any:
        if name == "rclpy":
            return ros
        package = name.removesuffix(".msg")

        class Messages:
            def __getattr__(self, kind: str) -> Any:
                return type(kind, (), {"__new__": lambda _: filled(f"{package}/msg/{kind}")})

        return Messages()

    monkeypatch.setattr("importlib.import_module", module)
    sender = RosNodeSender(parse("ros2://tool?frame=lab", SENDERS), HEADER)
    assert sender.send(Message(ESTIMATE))
    (topic, pose), (tf, transforms) = ros.published
    assert (topic, tf) == ("/tool", "/tf")
    assert pose.header.frame_id == "lab"
    assert pose.header.stamp.nanosec == 250_000_000
    assert pose.pose.pose.position.y == 0.02
    assert list(pose.pose.covariance[:1]) == [1e-6]
    (one,) = transforms.transforms
    assert (one.child_frame_id, one.transform.translation.z) == ("tool", 0.03)

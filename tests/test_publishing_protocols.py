"""What each protocol makes of a pose, by clients that stand for others."""

from __future__ import annotations

import json
import socket
import sys
from contextlib import suppress
from dataclasses import replace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from command_line import wait_until
from published_pose import ESTIMATE, HEADER

from mixpose.publishing.channel import PublishingRules
from mixpose.publishing.lsl import LslSender
from mixpose.publishing.message import Message, parse
from mixpose.publishing.mqtt import MqttSender
from mixpose.publishing.ros2 import RosNodeSender, ros_messages, topics
from mixpose.publishing.sockets import OscSender
from mixpose.publishing.ws import WebSocketSender


def test_pages_count_as_receivers_from_when_one_is_there() -> None:
    client = pytest.importorskip("websockets.sync.client")
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"ws://127.0.0.1:{free.getsockname()[1]}/poses"
    sender = WebSocketSender(parse(url), HEADER)
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
    sender = WebSocketSender(parse(f"ws://127.0.0.1:{port}"), HEADER)
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
        sender = OscSender(parse(url), HEADER)
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
    monkeypatch.setattr("mixpose.errors.find_spec", lambda _: True)
    client: MagicMock = module.Client.return_value
    client.publish.return_value = MagicMock(rc=0)
    client.loop_start.side_effect = lambda: client.on_connect(
        None, None, None, MagicMock(is_failure=False), None
    )
    return client


def test_a_broker_is_looked_for_at_the_port_of_its_protocol(broker: MagicMock) -> None:
    sender = MqttSender(parse("mqtt://there/rig"), HEADER)
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
    sender = MqttSender(parse("mqtt://there/rig"), replace(HEADER, objects={"header": 1}))
    sender.connect()
    assert sender.send(Message(replace(ESTIMATE, object="header")))
    topics = [call.args[0] for call in broker.publish.call_args_list]
    assert topics == ["rig/header", "rig/header_2"]


def test_a_broker_that_refuses_or_is_silent_is_away(
    broker: MagicMock, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender = MqttSender(parse("mqtt://there:9/rig"), HEADER)
    refusal = MagicMock(is_failure=True, __str__=lambda _: "Not authorized")
    broker.loop_start.side_effect = lambda: broker.on_connect(None, None, None, refusal, None)
    with pytest.raises(ConnectionError, match="Not authorized"):
        sender.connect()
    broker.loop_start.side_effect = None
    monkeypatch.setattr(PublishingRules, "connect_s", 0.01)
    with pytest.raises(TimeoutError, match="the broker does not answer"):
        sender.connect()
    broker.publish.assert_not_called()


def test_several_bodies_have_topics_of_their_own() -> None:
    header = replace(HEADER, objects={"left hand": 1, "cup": 2, "\u5de6": 1, "\u53f3": 1})
    found = topics(parse("ros2://rig/poses"), header)
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
    monkeypatch.setattr("mixpose.errors.find_spec", lambda _: True)
    sender = LslSender(parse("lsl://rig"), HEADER)
    _, _, channels, *_ = pylsl.StreamInfo.call_args.args
    lost = replace(ESTIMATE, status="lost", T_world_object=None, covariance=None)
    for estimate, status in ((lost, 0.0), (ESTIMATE, 2.0)):
        sender.send(Message(estimate))
        sample, stamp = pylsl.StreamOutlet.return_value.push_sample.call_args.args
        assert len(sample) == channels == 9
        assert sample[7:] == [status, 7.0]
        assert np.isnan(sample[:7]).all() == (status == 0.0)
        assert stamp == 50.0  # nothing is known of when the frame was taken


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
    sender = RosNodeSender(parse("ros2://tool?frame=lab"), HEADER)
    assert sender.send(Message(ESTIMATE))
    (topic, pose), (tf, transforms) = ros.published
    assert (topic, tf) == ("/tool", "/tf")
    assert pose.header.frame_id == "lab"
    assert pose.header.stamp.nanosec == 250_000_000
    assert pose.pose.pose.position.y == 0.02
    assert list(pose.pose.covariance[:1]) == [1e-6]
    (one,) = transforms.transforms
    assert (one.child_frame_id, one.transform.translation.z) == ("tool", 0.03)

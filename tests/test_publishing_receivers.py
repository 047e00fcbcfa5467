"""Poses published to programs of their own, by each protocol, over this machine's loopback."""

from __future__ import annotations

import asyncio
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from command_line import lines_of, started, wait_until
from published_pose import HEADER

from mixpose.publishing import Publishing
from mixpose.publishing.channel import PublishingRules
from mixpose.publishing.ws import _Client, _Line
from mixpose.records import Estimate, FrameSet, Moment, RawFrame, SensorReport

CLIP = Path(__file__).parents[1] / "data" / "synthetic" / "one_camera_video" / "camera.avi"
PROTOCOLS = ["udp", "tcp", "ws", "osc", "lsl", "mqtt", "ros2"]
LISTENERS = ("ws", "lsl")  # of which mixpose is the one that is connected to


@dataclass
class Receiver:
    """What a receiver has said so far."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)

    @property
    def poses(self) -> list[dict[str, Any]]:
        return [one for one in lines_of("\n".join(self.said)) if "frame" in one]

    @property
    def frames(self) -> list[int]:
        return [one["frame"] for one in self.poses]

    @property
    def said(self) -> list[str]:
        return [line for line in list(self.lines) if line != "ready"]

    def is_ready(self) -> bool:
        return "ready" in self.lines

    def listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.strip())


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[Callable[..., Receiver]]:
    """Starts receivers, which end with the test."""
    config = tmp_path / "lsl_api.cfg"
    config.write_text("[multicast]\nResolveScope = machine\n[log]\nlevel = -3\n")
    os.environ["LSLAPICFG"] = str(config)
    with ExitStack() as stack:

        def start(kind: str, place: str | int, *, wait: bool = True) -> Receiver:
            command = [sys.executable, str(Path(__file__).with_name("receivers.py")), kind]
            process = stack.enter_context(started([*command, str(place)], stdout=subprocess.PIPE))
            made = Receiver(process)
            thread = threading.Thread(target=made.listen)
            thread.start()
            stack.callback(thread.join)
            stack.callback(process.kill)
            if wait:
                wait_until(made.is_ready, by=process)
            return made

        yield start


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def url_of(protocol: str, place: str | int) -> str:
    return {
        "ws": f"ws://127.0.0.1:{place}/poses",
        "lsl": f"lsl://{place}",
        "mqtt": f"mqtt://127.0.0.1:{place}/rig",
        "ros2": f"ros2://tracker?bridge=127.0.0.1:{place}",
    }.get(protocol, f"{protocol}://127.0.0.1:{place}")


def place_of(protocol: str) -> str | int:
    return f"mixpose-{os.getpid()}-{time.monotonic_ns()}" if protocol == "lsl" else free_port()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_receivers_of_all_protocols_get_every_pose_in_order(
    receiver: Callable[..., Receiver], tmp_path: Path
) -> None:
    pipe, output = tmp_path / "camera", tmp_path / "poses.jsonl"
    os.mkfifo(pipe)
    places = {protocol: place_of(protocol) for protocol in PROTOCOLS}
    receiver("broker", places["mqtt"])
    receivers = {each: receiver(each, places[each]) for each in PROTOCOLS if each not in LISTENERS}
    command = [sys.executable, "-m", "mixpose", "run", str(CLIP.with_name("session.toml"))]
    command += ["--source", f"camera={pipe}", "-o", str(output)]
    for protocol, place in places.items():
        command += ["--publish", url_of(protocol, place)]
    with started(command, stderr=subprocess.PIPE) as run:
        receivers |= {each: receiver(each, places[each]) for each in LISTENERS}
        began = time.monotonic()
        pipe.write_bytes(CLIP.read_bytes())
        _, errors = run.communicate()
    ended = time.monotonic()
    assert run.returncode == 0, errors
    _, *written = lines_of(output.read_text())
    assert len(written) == 60
    for protocol, each in receivers.items():
        wait_until(lambda each=each: len(each.poses) == 60, by=each.process)  # type: ignore[misc]
        assert f"published to {url_of(protocol, places[protocol])}: 60 poses; " in errors
        assert "dropped" not in errors
        found = np.array([one["position"] for one in each.poses])
        expected = np.array([line["T_world_object"] for line in written])[:, :3, 3]
        unit = 1000.0 if protocol == "ros2" else 1.0  # of which ROS has metres
        # OSC's numbers have 24 bits; what is written in decimals is read as it was
        tolerance = 1e-6 if protocol == "osc" else 1e-14
        np.testing.assert_allclose(unit * found, expected, rtol=tolerance, err_msg=protocol)
        if protocol != "ros2":
            assert each.frames == [line["frame"] for line in written]
        assert all(began < one["at"] < ended + 60 for one in each.poses)
    stamps = [one["stamp_s"] for one in receivers["udp"].poses]
    assert stamps == [one["stamp_s"] for one in receivers["osc"].poses]
    assert all(a < b for a, b in pairwise(stamps))
    # a pose comes after its frame; of LSL by its own clock
    to_unix = time.time() - time.monotonic()
    assert all(0 < one["at"] + to_unix - one["stamp_s"] < 60 for one in receivers["udp"].poses)
    assert all(0 < one["age_s"] < 60 for one in receivers["lsl"].poses)
    assert {one["stamp_of"] for one in receivers["udp"].poses} == {"arrival"}
    for protocol in ("udp", "tcp", "mqtt"):
        assert receivers[protocol].said[0] == '{"unit": "mm"}'
    for pose in receivers["ros2"].poses:
        assert list(pose["tf"].values()) == pose["position"]


def estimate_of(frame: int) -> Estimate:
    T = np.eye(4)
    T[0, 3] = frame
    residuals = {f"marker {k}": 0.1 for k in range(8)}
    sensors = {f"camera {k}": SensorReport(True, 0.9, 0.1, None, residuals) for k in range(4)}
    return Estimate(frame, 0.01 * frame, "tool", "ok", T, np.eye(6), 0.9, sensors)


class Feed:
    """Publishes frames that are numbered from 0."""

    def __init__(self, publishing: Publishing) -> None:
        self.publishing, self.count = publishing, 0

    def one(self) -> None:
        moment = Moment(time.monotonic(), "capture")
        image = np.zeros((1, 1), np.uint8)
        frames = {"camera": RawFrame(self.count, None, image, moment)}
        estimate = estimate_of(self.count)
        self.publishing.watch(FrameSet(self.count, None, frames), (), estimate)
        self.count += 1

    def until(self, condition: Callable[[], bool], receiver: Receiver | None = None) -> None:
        def met() -> bool:
            self.one()
            return condition()

        wait_until(met, by=None if receiver is None else receiver.process)


QUICK = replace(PublishingRules(), retry_s=0.05, farewell_s=1.0)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_receiver_that_is_killed_and_started_again_gets_what_is_new(
    protocol: str, receiver: Callable[..., Receiver]
) -> None:
    place, said = place_of(protocol), list[str]()
    counterpart = "broker" if protocol == "mqtt" else protocol
    with ExitStack() as stack:
        first = None if protocol in LISTENERS else receiver(counterpart, place)
        publishing = Publishing([url_of(protocol, place)], HEADER, said.append, rules=QUICK)
        feed = Feed(stack.enter_context(publishing))
        first = first or receiver(protocol, place)
        hears = receiver("mqtt", place) if protocol == "mqtt" else first
        feed.until(lambda: len(hears.poses) >= 5, hears)
        before = hears.poses
        first.process.kill()
        hears.process.kill()
        first.process.wait()
        gone = feed.count
        for _ in range(20):
            feed.one()
        # the last thing that was known of TCP and its kin is that all arrives
        notices = protocol in ("tcp", "mqtt", "ros2")
        feed.until(lambda: not notices or any("is away" in line for line in said))
        second = receiver(counterpart, place, wait=protocol not in LISTENERS)
        again = receiver("mqtt", place) if protocol == "mqtt" else second
        feed.until(lambda: len(again.poses) >= 5, again)
        after = again.poses
    for poses in (before, after):
        numbers = [one["position"][0] for one in poses]
        assert all(a < b for a, b in pairwise(numbers)), protocol
    unit = 1000.0 if protocol == "ros2" else 1.0
    assert unit * after[-1]["position"][0] > gone
    if notices:
        assert any("the receiver is there" in line for line in said)


def test_receivers_that_never_read_cost_a_run_next_to_nothing(
    receiver: Callable[..., Receiver],
) -> None:
    places = {each: free_port() for each in ("tcp", "mqtt", "ros2", "ws")}
    for protocol in ("tcp", "mqtt", "ros2"):
        receiver(f"stalled_{protocol}", places[protocol])
    urls, said = [url_of(*each) for each in places.items()], list[str]()
    with Publishing(urls, HEADER, said.append, rules=QUICK) as publishing:
        receiver("stalled_ws", places["ws"])
        feed = Feed(publishing)
        for _ in range(400):  # of 3 kB; the system holds some 100 of them for each
            feed.one()
            time.sleep(2e-3)
        began = time.process_time()
        for _ in range(1000):
            feed.one()
        each_ms = time.process_time() - began  # of this process with all its threads
    # 5 % of the processor time of a frame, 2 ms and more, for each; the frames themselves,
    # as they are made here, count too
    assert each_ms < 4 * 0.05 * 2
    for line in said:
        assert "poses" in line
        assert int(line.split(" dropped")[0].split()[-1]) > 500, line
        # each pose is counted once
        assert sum(map(int, re.findall(r"(\d+) (?:poses?|more|dropped)", line))) == 1400, line
    assert len(said) == 4


@pytest.mark.parametrize(("since_s", "is_stuck"), [(None, False), (0.0, False), (1.0, True)])
def test_a_browser_is_stuck_from_a_quarter_of_a_second_in_one_send(
    since_s: float | None, is_stuck: bool
) -> None:
    async def told() -> bool:
        now = asyncio.get_running_loop().time()
        line = None if since_s is None else _Line("", 1)
        return _Client(MagicMock(), sending=line, began=now - (since_s or 0.0)).is_stuck()

    assert asyncio.run(told()) == is_stuck

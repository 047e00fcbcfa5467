"""What is published in datagrams: none can be larger than the system takes."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from published_pose import ESTIMATE, HEADER

from mixpose.poses.header import Header
from mixpose.publishing import Publishing
from mixpose.records import Estimate, FrameSet


def published(
    scheme: str, header: Header, estimates: Sequence[Estimate]
) -> tuple[list[bytes], list[str]]:
    """What arrives, and what is told, with the address left out."""
    told: list[str] = []
    arrived = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        receiving.bind(("127.0.0.1", 0))
        url = f"{scheme}://127.0.0.1:{receiving.getsockname()[1]}"
        with Publishing([url], header, told.append) as publishing:
            for each in estimates:
                publishing.watch(FrameSet(each.frame, each.time_s, {}), None, each)
        receiving.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                arrived.append(receiving.recv(65536))
    return arrived, [text.replace(url, "URL") for text in told]


@pytest.mark.parametrize("scheme", ["udp", "osc"])
def test_what_is_too_large_is_dropped_told_once_and_holds_nothing_up(scheme: str) -> None:
    if scheme == "osc":
        pytest.importorskip("pythonosc")
    large = replace(ESTIMATE, object="tool" * 20_000)
    # by udp the header would be too large as well
    header = replace(HEADER, objects={"tool": 1, large.object: 1}) if scheme == "osc" else HEADER
    arrived, (warning, end) = published(scheme, header, [large, large, ESTIMATE])
    assert b"tool" in arrived[-1]
    assert warning.startswith("warning: --publish URL: the ")
    assert " has 80," in warning
    assert "bytes, more than a datagram can be here; " in warning
    assert ("publish to tcp://" if scheme == "udp" else "shorten the name") in warning
    assert end == "published to URL: 1 pose, 2 dropped: too large"


def test_poses_go_on_without_a_header_that_is_too_large() -> None:
    header = replace(HEADER, symmetries={"tool": np.tile(np.eye(4), (2000, 1, 1))})
    arrived, told = published("udp", header, [replace(ESTIMATE, frame=k) for k in (1, 2, 3)])
    assert [json.loads(data)["frame"] for data in arrived] == [2, 3]
    assert len(told) == 2
    assert "the header has " in told[0]
    assert "publish to tcp:// or ws://, which carry any size" in told[0]


def test_frame_numbers_beyond_32_bits_are_sent_in_64() -> None:
    pytest.importorskip("pythonosc")
    stamp = 1_403_636_579_763_555_584  # ns, the name of a file of images
    frames = (-(2**31), -(2**31) - 1, 2**31 - 1, 2**31, stamp)
    estimates = [replace(ESTIMATE, frame=frame) for frame in frames]
    arrived, (end,) = published("osc", HEADER, estimates)
    assert end == "published to URL: 5 poses"
    kinds = [data.partition(b",")[2][:3].decode() for data in arrived]
    assert kinds == ["ids", "hds", "ids", "hds", "hds"]
    assert struct.pack(">q", stamp) in arrived[4]


def test_poses_go_on_after_one_that_cannot_be_put_in_a_message() -> None:
    pytest.importorskip("pythonosc")
    beyond = replace(ESTIMATE, frame=2**63)
    arrived, (warning, end) = published("osc", HEADER, [beyond, beyond, ESTIMATE])
    assert len(arrived) == 1
    assert f"warning: --publish URL: frame {2**63} cannot be sent: " in warning
    assert warning.endswith("; the run goes on")
    assert end == "published to URL: 1 pose, 2 dropped: they could not be sent"

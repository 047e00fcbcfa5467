"""Receivers of published poses, each a program of its own that knows nothing of mixpose.

    python tests/receivers.py PROTOCOL PLACE

says `ready` when it listens, and then a line of JSON for each pose: its frame, the status, the
position, and when it arrived by the steady clock.  Those that are `stalled_` say hello and never
read.
"""

from __future__ import annotations

import asyncio
import json
import math
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any


def tell(frame: float, status: str, position: Any, **more: Any) -> None:
    """Say what arrived."""
    line = {"frame": int(frame), "status": status, "position": position, "at": time.monotonic()}
    print(json.dumps({**line, **more}), flush=True)


def tell_line(text: str | bytes) -> None:
    """Say what is in a pose line; of a header its unit."""
    line = json.loads(text)
    if line["type"] == "header":
        print(json.dumps({"unit": line["unit"]}), flush=True)
        return
    T = line["T_world_object"]
    position = None if T is None else [row[3] for row in T[:3]]
    more = {key: line[key] for key in ("stamp_s", "stamp_of", "ahead_s", "time_s") if key in line}
    tell(line["frame"], line["status"], position, **more)


def udp(place: str) -> None:
    receiving = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiving.bind(("127.0.0.1", int(place)))
    print("ready", flush=True)
    while True:
        tell_line(bytes(receiving.recv(65536)))


def listening(place: str) -> socket.socket:
    server = socket.create_server(("127.0.0.1", int(place)))
    print("ready", flush=True)
    return server


def tcp(place: str) -> None:
    with listening(place) as server:
        while True:
            connection, _ = server.accept()
            for line in connection.makefile("rb"):
                tell_line(line)


def stalled_tcp(place: str) -> None:
    stall(place, b"")


def stalled_mqtt(place: str) -> None:
    stall(place, bytes([0x20, 2, 0, 0]))  # CONNACK: welcome


def stall(place: str, welcome: bytes) -> None:
    kept = []
    with listening(place) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**14)
        while True:
            kept.append(server.accept()[0])
            kept[-1].sendall(welcome)


def stalled_ros2(place: str) -> None:
    serve_sockets(lambda _: time.sleep(1e6), place)


def serve_sockets(handler: Callable[[Any], None], place: str) -> None:
    from websockets.sync.server import serve

    with serve(handler, "127.0.0.1", int(place), max_queue=1) as server:
        print("ready", flush=True)
        server.serve_forever()


def stalled_ws(place: str) -> None:
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{place}/poses", max_queue=1):
        print("ready", flush=True)
        time.sleep(1e6)


def ws(place: str) -> None:
    from websockets.sync.client import connect

    while True:
        with suppress(OSError), connect(f"ws://127.0.0.1:{place}/poses") as connection:
            for number, text in enumerate(connection):
                tell_line(text)
                if not number:
                    print("ready", flush=True)
        time.sleep(0.05)


def osc(place: str) -> None:
    from pythonosc.dispatcher import Dispatcher
    from pythonosc.osc_server import BlockingOSCUDPServer

    def take(path: str, *values: Any) -> None:
        frame, time_s, status, *pose = values
        tell(frame, status, pose[:3] or None, path=path, stamp_s=time_s)

    dispatcher = Dispatcher()
    dispatcher.map("/*", take)
    server = BlockingOSCUDPServer(("127.0.0.1", int(place)), dispatcher)
    print("ready", flush=True)
    server.serve_forever()


def lsl(place: str) -> None:
    import pylsl
    from pylsl.util import LostError

    found: list[Any] = []
    while not found:
        found = pylsl.resolve_byprop("name", place, timeout=5.0)
    inlet = pylsl.StreamInlet(found[0], recover=False)
    inlet.open_stream()
    print("ready", flush=True)
    with suppress(LostError):
        while True:
            sample, stamp = inlet.pull_sample()
            status = {0: "lost", 1: "ambiguous", 2: "ok"}[int(sample[7])]
            position = None if math.isnan(sample[0]) else list(sample[:3])
            tell(sample[8], status, position, age_s=pylsl.local_clock() - stamp)


def mqtt(place: str) -> None:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    def on_connect(client: Any, *_: Any) -> None:
        client.subscribe("rig/#")

    client = Client(CallbackAPIVersion.VERSION2)
    client.on_connect = on_connect
    client.on_subscribe = lambda *_: print("ready", flush=True)
    client.on_message = lambda _, __, message: tell_line(bytes(message.payload))
    client.connect("127.0.0.1", int(place))
    client.loop_forever()


def broker(place: str) -> None:
    from amqtt.broker import Broker

    async def serve() -> None:
        listener = {"type": "tcp", "bind": f"127.0.0.1:{place}"}
        plugins = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
        await Broker({"listeners": {"default": listener}, "plugins": plugins}).start()
        print("ready", flush=True)
        await asyncio.Event().wait()

    asyncio.run(serve())


def ros2(place: str) -> None:
    """A rosbridge: takes what was advertised, of types that ROS has, with all their fields."""
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def check(kind: str, fields: Any) -> None:
        known = dict(store.fielddefs[kind][1])
        assert set(fields) == set(known), f"{kind}: {sorted(fields)}"
        for name, (sort, detail) in known.items():
            if sort == Nodetype.NAME:
                check(detail, fields[name])  # type: ignore[arg-type]
            elif isinstance(fields[name], list) and name == "transforms":
                for each in fields[name]:
                    check("geometry_msgs/msg/TransformStamped", each)

    def take(connection: Any) -> None:
        kinds: dict[str, str] = {}
        status = {}
        for text in connection:
            said = json.loads(text)
            if said["op"] == "advertise":
                kinds[said["topic"]] = said["type"]
                continue
            assert said["op"] == "publish"
            check(kinds[said["topic"]], said["msg"])
            if said["topic"] == "/tf":
                (transform,) = said["msg"]["transforms"]
                status["tf"] = transform["transform"]["translation"]
                tell(status["frame"], "ok", status["position"], tf=status["tf"])
            else:
                stamp = said["msg"]["header"]["stamp"]
                position = said["msg"]["pose"]["pose"]["position"]
                seconds = stamp["sec"] + 1e-9 * stamp["nanosec"]
                status = {"frame": seconds, "position": [position[one] for one in "xyz"]}

    serve_sockets(take, place)


RECEIVERS: dict[str, Callable[[str], None]] = {
    one.__name__: one
    for one in (
        stalled_tcp,
        stalled_mqtt,
        stalled_ros2,
        stalled_ws,
        udp,
        tcp,
        ws,
        osc,
        lsl,
        mqtt,
        broker,
        ros2,
    )
}

if __name__ == "__main__":
    RECEIVERS[sys.argv[1]](sys.argv[2])

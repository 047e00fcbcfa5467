"""MQTT 3.1.1 by paho, for receivers that are connected to a broker."""

from __future__ import annotations

import socket
import threading
from typing import TYPE_CHECKING, Any, cast

from mixpose.poses.header import Header
from mixpose.poses.jsonl import header_text
from mixpose.publishing.channel import PublishingRules
from mixpose.publishing.message import Address, Message, Sender, path_words
from mixpose.publishing.sockets import force_down, keep_little

if TYPE_CHECKING:
    from paho.mqtt.client import Client

_PORT = 1883
_HEADER = "header"  # its topic, which no body has
_LOOK_S = 0.2  # between tests of the connection while a message waits


class MqttSender(Sender):
    """Publish pose lines to ``mqtt://user:password@host:port/topic``, topics ``topic/<body>``.

    Quality of service 0, at most once, as late poses are useless.  ``topic/header`` is retained.
    """

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        address.needs("paho", "mqtt")
        self._address = address
        self._place = address.place("mqtt://127.0.0.1:1883/tracker", _PORT)
        self._topic = address.path or "mixpose"
        if set("+#") & set(self._topic):
            raise address.error("topic: found + or #, which name many; allowed: a topic without")
        self._words = path_words((_HEADER, *header.labels))
        self._header = header_text(header)
        self._client: Client | None = None
        self._is_sending = False

    def connect(self) -> None:
        """Connect, and publish the header."""
        from paho.mqtt.client import Client  # noqa: PLC0415 - an extra
        from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415

        client = Client(CallbackAPIVersion.VERSION2, reconnect_on_failure=False)
        self._client = client
        if self._address.user is not None:
            client.username_pw_set(self._address.user, self._address.password)
        client.connect_timeout = PublishingRules.connect_s
        answered, refused = threading.Event(), list[str]()

        def on_connect(_: Any, __: Any, ___: Any, reason: Any, ____: Any) -> None:
            if reason.is_failure:
                refused.append(str(reason))
            answered.set()

        client.on_connect = on_connect
        client.on_socket_open = lambda _, __, connection: keep_little(
            cast(socket.socket, connection)
        )
        client.connect(*self._place)
        client.loop_start()
        if not answered.wait(PublishingRules.connect_s):
            raise TimeoutError("the broker does not answer")
        if refused:
            raise ConnectionError(refused[0])
        self._publish(_HEADER, self._header, retain=True)

    def send(self, message: Message) -> bool:
        """Publish the line of one body, and wait until it is sent."""
        self._publish(self._words[message.estimate.label], message.text)
        return True

    def _publish(self, name: str, text: str, *, retain: bool = False) -> None:
        assert self._client is not None
        sent = self._client.publish(f"{self._topic}/{name}", text, retain=retain)
        self._is_sending = True
        while not sent.rc and not sent.is_published():
            sent.wait_for_publish(_LOOK_S)
            if not self._client.is_connected():
                break
        self._is_sending = False
        if sent.rc or not sent.is_published():
            raise ConnectionError("the broker has gone")

    def close(self) -> None:
        """Disconnect; by force if a message waits for a broker that does not read."""
        if self._client is None:
            return
        connection = self._client.socket()
        self._client.disconnect()
        if self._is_sending and connection is not None:
            force_down(cast(socket.socket, connection))
        self._client.loop_stop()

"""Open Sound Control 1.0 by python-osc, for sound, light and stage."""

from __future__ import annotations

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.message import Message, path_word
from mixpose.publishing.sockets import Datagrams


class OscSender(Datagrams):
    """Sends to ``osc://host:port/prefix``, whether anybody listens there or not.

    A message ``/prefix/<body>`` has the frame number (i), the time of the frame in seconds (d;
    of a live source those since 1970), the status (s), and but for a lost frame x y z in the unit
    of the session and the quaternion x y z w (7 f).
    """

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        address.needs("pythonosc", "osc")
        super().__init__(address.place("osc://127.0.0.1:9000"))
        self._prefix = f"/{address.path or 'mixpose'}"
        self.dropped = 0

    def send(self, message: Message) -> bool:
        """Send the message of one body."""
        from pythonosc.osc_message_builder import OscMessageBuilder  # noqa: PLC0415 - an extra

        estimate = message.estimate
        built = OscMessageBuilder(f"{self._prefix}/{path_word(estimate.label)}")
        built.add_arg(int(estimate.frame), "i")
        time_s = estimate.time_s if message.unix_s is None else message.unix_s
        built.add_arg(float(estimate.frame if time_s is None else time_s), "d")
        built.add_arg(estimate.status, "s")
        T = estimate.T_world_object
        if T is not None:
            for value in (*T[:3, 3].tolist(), *rigid.quaternion_xyzw(T).tolist()):
                built.add_arg(value, "f")
        self.put(built.build().dgram)
        return True

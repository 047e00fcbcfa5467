"""Lab Streaming Layer by pylsl, for experiments that record many devices."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.publishing.message import Address, Message, Sender

if TYPE_CHECKING:
    from pylsl import StreamOutlet

# labels, types and units as of https://github.com/sccn/xdf/wiki/MoCap-Meta-Data
_PLACE = [*(f"Position{axis}" for axis in "XYZ"), *(f"Orientation{axis}" for axis in "XYZW")]
_CHANNELS = (*_PLACE, "Status", "Frame")
_STATUS = {"lost": 0.0, "ambiguous": 1.0, "ok": 2.0}
_FLUSH_S = 0.5  # outlets send in a thread of their own, which ends with them


class LslSender(Sender):
    """An outlet ``lsl://name``; for several bodies ``name-<body>`` for each.

    Channels (float64, irregular rate): x y z in the unit of the session, the quaternion x y z w,
    the status (0 lost, 1 ambiguous, 2 ok) and the frame number; NaN, as usual in LSL, for the pose
    of a lost frame.  The time of a sample is that of its frame by LSL's clock.
    """

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        if not address.name:
            raise address.error("found no name; allowed: lsl://tracker")
        address.needs("pylsl", "lsl")
        try:
            import pylsl  # noqa: PLC0415 - an extra
        except RuntimeError as error:  # the package is installed without its library
            raise address.error(
                f"liblsl cannot be loaded: {' '.join(str(error).split())}"
            ) from error
        self._clock = pylsl.local_clock
        names = {label: f"{address.name}-{label}" for label in header.labels}
        if len(names) == 1:
            names = dict.fromkeys(names, address.name)
        # made now, so that receivers find them before the first pose
        self._outlets = {
            label: pylsl.StreamOutlet(_info(pylsl, name, header)) for label, name in names.items()
        }

    def send(self, message: Message) -> bool:
        """Push the sample of one body."""
        estimate, T = message.estimate, message.estimate.T_world_object
        pose = [float("nan")] * 7
        if T is not None:
            pose = [*T[:3, 3].tolist(), *rigid.quaternion_xyzw(T).tolist()]
        outlet: StreamOutlet = self._outlets[estimate.label]
        heard = bool(outlet.have_consumers())
        stamp = self._clock() - (message.age_s or 0.0)
        outlet.push_sample([*pose, _STATUS[estimate.status], float(estimate.frame)], stamp)
        return heard

    def close(self) -> None:
        """Wait until samples are sent, and end the streams."""
        if any(outlet.have_consumers() for outlet in self._outlets.values()):
            time.sleep(_FLUSH_S)
        self._outlets.clear()


def _info(pylsl: Any, stream: str, header: Header) -> Any:
    kind = "MoCap", len(_CHANNELS), pylsl.IRREGULAR_RATE, pylsl.cf_double64
    info = pylsl.StreamInfo(stream, *kind, f"mixpose-{stream}")
    description = info.desc()
    description.append_child_value("manufacturer", "mixpose")
    channels = description.append_child("channels")
    for name in _CHANNELS:
        channel = channels.append_child("channel")
        channel.append_child_value("label", name)
        channel.append_child_value("type", name)
        if name in _PLACE:
            unit = header.unit if name.startswith("Position") else "quaternion"
            channel.append_child_value("unit", unit)
    return info

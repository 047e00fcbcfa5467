"""All receivers of a run."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import TracebackType

from mixpose.poses.header import Header
from mixpose.poses.writing import require_finite
from mixpose.publishing.address import parse
from mixpose.publishing.backlog import PublishingRules
from mixpose.publishing.channel import Channel
from mixpose.publishing.message import Message
from mixpose.publishing.senders import SENDERS, sender_for
from mixpose.records import Estimate, FrameSet

Foresee = Callable[[Estimate], Estimate]
"""Makes of an estimate the one that is foretold."""


class Publishing:
    """Publishes estimates to receivers, which neither slow a run nor end it.

    Parameters
    ----------
    urls : sequence of str
    header : Header
        Of the run.
    tell : callable
        Says a line to people.
    foresee : mapping of str to callable
        By label of a body; where there is none, estimates are published as they are.
    ahead_s : float
        What these callables look ahead.
    rules : PublishingRules

    Raises
    ------
    SessionError
        If an address is wrong, its package is not installed, or it cannot be listened at.
    """

    def __init__(
        self,
        urls: Sequence[str],
        header: Header,
        tell: Callable[[str], None],
        foresee: Mapping[str, Foresee] | None = None,
        ahead_s: float = 0.0,
        rules: PublishingRules = PublishingRules(),
    ) -> None:
        self._foresee, self._ahead_s, self._tell = foresee or {}, ahead_s, tell
        addresses = [parse(url, SENDERS) for url in urls]
        self._channels = [
            Channel(each, sender_for(each, header), tell, rules) for each in addresses
        ]

    def __enter__(self) -> Publishing:
        for channel in self._channels:
            channel.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for channel in self._channels:
            channel.end()
        closing = [threading.Thread(target=channel.close) for channel in self._channels]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join()
        for channel in self._channels:
            self._tell(channel.text())

    def watch(self, frame_set: FrameSet, _: object, estimate: Estimate) -> None:
        """Publish an estimate of a frame; to be given to `mixpose.run`.

        Raises
        ------
        SessionError
            If it is to be foretold, and the frame has no time.
        """
        require_finite(estimate)
        # what tells its offsets holds all that the frame was made from
        estimate = replace(estimate, measured=dict)
        foresee = self._foresee.get(estimate.label)
        if foresee is not None:
            estimate = foresee(estimate)
        message = Message(estimate, frame_set.moment, self._ahead_s if foresee else 0.0)
        for channel in self._channels:
            channel.put(message)

"""Publish poses to other programs while they are estimated.

A new protocol is a file with its `Sender` and a line in `mixpose.publishing.message`.
"""

from mixpose.publishing.channel import Publishing as Publishing

"""Publishing: poses to other programs while they are estimated.

A new protocol is one file with its `Sender` and one line in `mixpose.publishing.message`.
"""

from mixpose.publishing.channel import Publishing as Publishing

"""Publishing: poses to other programs while they are estimated.

A new protocol is one file with its `Sender` and one line in `mixpose.publishing.senders`.
"""

from mixpose.publishing.publishing import Publishing as Publishing
from mixpose.publishing.senders import SENDERS as SENDERS

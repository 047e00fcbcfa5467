"""Options whose value may be left out, which the parser of the command line does not know."""

from __future__ import annotations

import re
from collections.abc import Sequence

_ADDRESS = re.compile(r"(.*:)?\d+")
OPTIONAL = {"--view": _ADDRESS}
"""What a value of each looks like; anything else after it is the next argument."""


def with_values(arguments: Sequence[str]) -> list[str]:
    """Arguments in which each of these options has a value, an empty one where none was given."""
    given: list[str] = []
    for k, argument in enumerate(arguments):
        pattern = OPTIONAL.get(argument)
        following = arguments[k + 1] if k + 1 < len(arguments) else ""
        has_value = pattern is None or pattern.fullmatch(following) is not None
        given.append(argument if has_value else f"{argument}=")
    return given

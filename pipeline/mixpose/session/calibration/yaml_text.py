"""YAML, also with the first line that OpenCV's dialect has and YAML does not know."""

from __future__ import annotations

import re
from typing import Any

from mixpose.limits import MOST_YAML_CHARACTERS, MOST_YAML_NODES
from mixpose.session.messages import BadKeyError

_OPENCV_HEAD = re.compile(r"\A\s*%YAML:?[ \d.]*[^\n]*\n(---[^\n]*\n)?")


def parse_yaml(text: str) -> Any:
    """Parse the first document of a YAML text."""
    import yaml  # noqa: PLC0415  # only sessions with such a calibration need it

    if len(text) > MOST_YAML_CHARACTERS:
        raise BadKeyError(
            f"found {len(text)} characters of YAML; allowed: at most {MOST_YAML_CHARACTERS}"
        )
    text = _OPENCV_HEAD.sub("", text)
    try:
        large = any(map(_is_large, yaml.compose_all(text, yaml.SafeLoader)))
        documents = () if large else yaml.safe_load_all(text)
        content = next((part for part in documents if part is not None), None)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" at line {mark.line + 1}" if mark else ""
        raise BadKeyError(f"not YAML{line}: {error.problem or error.context}") from error
    except RecursionError as error:
        raise BadKeyError("lists or tables in it are nested too deeply") from error
    except (yaml.YAMLError, ValueError, LookupError, TypeError) as error:
        raise BadKeyError(f"not YAML: {error}") from error
    if large:
        raise BadKeyError(
            f"its aliases (*name) stand for more than {MOST_YAML_NODES} values; write out what is "
            "meant"
        )
    return content


def _is_large(root: Any) -> bool:
    """Whether aliases make a document large: a few bytes may stand for gigabytes."""
    sizes: dict[int, float] = {}

    def size_of(node: Any) -> float:
        known = sizes.get(id(node))
        if known is not None:
            return known
        sizes[id(node)] = float("inf")  # met again inside of itself: without end
        parts = [] if isinstance(node.value, str) else node.value
        flat = [each for part in parts for each in (part if isinstance(part, tuple) else (part,))]
        sizes[id(node)] = 1 + sum(map(size_of, flat))
        return sizes[id(node)]

    return root is not None and size_of(root) > MOST_YAML_NODES

"""YAML, also with the first line that OpenCV's dialect has and YAML does not know."""

from __future__ import annotations

import re
from typing import Any

from mixpose.session.messages import BadKeyError

_OPENCV_HEAD = re.compile(r"\A\s*%YAML:?[ \d.]*[^\n]*\n(---[^\n]*\n)?")


def parse_yaml(text: str) -> Any:
    """Parse the first document of a YAML text.

    Raises
    ------
    BadKeyError
    """
    import yaml  # noqa: PLC0415  # only sessions with such a calibration need it

    try:
        documents = yaml.safe_load_all(_OPENCV_HEAD.sub("", text))
        return next((part for part in documents if part is not None), None)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" at line {mark.line + 1}" if mark else ""
        raise BadKeyError(f"not YAML{line}: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise BadKeyError(f"not YAML: {error}") from error

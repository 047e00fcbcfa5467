"""What is said of an EOFError: no command reads what is typed, so that a file must be cut."""

from __future__ import annotations

import traceback


def cut_message(error: EOFError) -> str:
    """One line: which compiled module ends too early, where it was one that was imported."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        path = frame.f_locals.get("bytecode_path")  # as importlib calls it
        if isinstance(path, str):
            return f"{path}: is damaged: {error}; remove this file, Python makes it anew"
    return f"a file ends too early: {error or 'EOFError'}; --debug shows where it was read"

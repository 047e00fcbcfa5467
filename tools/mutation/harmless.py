"""Mutants by rule that no test need notice, each with the reason.

They are known by their file and their line without and with the change, wherever that stands.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Harmless:
    """A mutant that changes nothing that anybody is promised.

    Attributes
    ----------
    file : str
        Below `pipeline/mixpose`.
    old, new : str
        The line without and with the change, without its indentation.
    reason : str
    """

    file: str
    old: str
    new: str
    reason: str


HARMLESS: tuple[Harmless, ...] = ()

"""What a mutant is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath


class MutationError(Exception):
    """A mutant that cannot be tried: its text is not there, or the tests do not run with it."""


@dataclass(frozen=True)
class Mutant:
    """A small bug.

    Attributes
    ----------
    name : str
        Unique; begins with the room.
    file : str
        Where it goes, below `pipeline/mixpose`.
    before, after : str
        Text that stands in the file exactly once, and what replaces it.
    why : str
        What would be wrong for a user.
    tests : tuple of str
        Files of tests that are run before those of the room.
    """

    name: str
    file: str
    before: str
    after: str
    why: str
    tests: tuple[str, ...] = ()

    @property
    def room(self) -> str:
        """The room that it is put into."""
        return PurePosixPath(self.file).with_suffix("").parts[0]

    def mutated(self, text: str) -> str:
        """The text of its file with the bug in it.

        Raises
        ------
        MutationError
            If the text to be replaced does not stand there exactly once.
        """
        count = text.count(self.before)
        if count != 1:
            raise MutationError(
                f"{self.name}: found its text {count} times in {self.file}, allowed is once: "
                f"{self.before!r}; write the mutant anew for what the code is now"
            )
        return text.replace(self.before, self.after)

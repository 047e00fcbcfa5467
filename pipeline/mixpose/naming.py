"""Names that are told apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence


def distinct(
    wanted: Sequence[str], plain: Callable[[str], str], alike: Callable[[str], str] = str
) -> list[str]:
    """Names made plain, of which no two are alike: a number from 2 on is put behind others.

    Those that are plain already come first, and stay as they are. `alike` is the same of names that
    count as one: ``str.casefold`` for those of files, as some file systems know no capitals.
    """
    made = [plain(name) for name in wanted]
    taken: set[str] = set()
    found: dict[int, str] = {}
    for k in sorted(range(len(made)), key=lambda k: made[k] != wanted[k]):
        name, number = made[k], 2
        while alike(name) in taken:
            name, number = f"{made[k]}_{number}", number + 1
        taken.add(alike(name))
        found[k] = name
    return [found[k] for k in range(len(made))]

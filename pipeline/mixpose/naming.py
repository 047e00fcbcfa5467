"""Make names distinct."""

from __future__ import annotations

from collections.abc import Callable, Sequence


def distinct(
    wanted: Sequence[str], plain: Callable[[str], str], alike: Callable[[str], str] = str
) -> list[str]:
    """Make names plain and distinct by numbers, from 2 on, behind repeated ones.

    Names that are plain already come first, and stay as they are. `alike` maps names that count as
    the same to one: ``str.casefold`` for files, as some file systems ignore case.
    """
    plain_names = [plain(name) for name in wanted]
    taken: set[str] = set()
    names: dict[int, str] = {}
    for k in sorted(range(len(wanted)), key=lambda k: plain_names[k] != wanted[k]):
        name, number = plain_names[k], 2
        while alike(name) in taken:
            name, number = f"{plain_names[k]}_{number}", number + 1
        taken.add(alike(name))
        names[k] = name
    return [names[k] for k in range(len(wanted))]

"""Figures of a switch, and its line of the table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ablated.cases import Outcome, counted

Outcomes: TypeAlias = Mapping[str, Sequence[Outcome]]

HEADING = (
    "| switched off | right | ok | wrong ok | tracked: right | ok | wrong ok | rotation | position"
    " | squared error | processor ms | most changed |"
)
RULE = "| --- " * 12 + "|"
_MENTIONED = 3  # cases named in a line


@dataclass(frozen=True)
class Figures:
    """What is counted over the frames of one kind."""

    frames: int
    right: int
    wrong_ok: int
    ok: int


def figures(found: Outcomes, names: Sequence[str]) -> Figures:
    """Counts over cases."""
    all_of = [one for name in names for one in found[name]]
    right, wrong, ok = counted(all_of)
    return Figures(len(all_of), right, wrong, ok)


def squared_error(found: Outcomes) -> float:
    """Mean squared error per dimension of right poses that are ok: 1 where covariances hold."""
    values = [
        one.squared for case in found.values() for one in case
        if one.right and one.status == "ok" and np.isfinite(one.squared)
    ]  # fmt: skip
    return float(np.mean(values)) if values else float("nan")


def error_ratio(found: Outcomes, base: Outcomes, field: str) -> float:
    """Error of right poses against that with everything on: mean ratio over cases.

    Compared are the frames of a case that are right with and without; of their errors the root
    mean square.
    """
    ratios = []
    for name, case in found.items():
        both = [(a, b) for a, b in zip(case, base[name], strict=True) if a.right and b.right]
        here, there = (
            np.sqrt(np.mean([getattr(pair[k], field) ** 2 for pair in both])) if both else 0.0
            for k in (0, 1)
        )
        if there > 0:
            ratios.append(np.log(max(here / there, 1e-6)))
    return float(np.exp(np.mean(ratios))) if ratios else float("nan")


def mean_ms(found: Outcomes) -> float:
    """Processor time per frame."""
    return float(np.mean([one.ms for case in found.values() for one in case]))


def line(name: str, found: Outcomes, base: Outcomes, single: Sequence[str]) -> str:
    """One line of the table: differences against everything on, or that itself."""
    tracked = [case for case in found if case not in single]
    cells = [name]
    for names in (single, tracked):
        here, there = figures(found, names), figures(base, names)
        cells += [
            str(here.right) if found is base else _signed(here.right - there.right),
            str(here.ok) if found is base else _signed(here.ok - there.ok),
            str(here.wrong_ok) if found is base else _signed(here.wrong_ok - there.wrong_ok),
        ]
    if found is base:
        cells += ["1", "1", f"{squared_error(found):.2f}", f"{mean_ms(found):.1f}", ""]
    else:
        cells += [
            f"{error_ratio(found, base, 'angle_deg'):.3f}",
            f"{error_ratio(found, base, 'shift'):.3f}",
            _signed(squared_error(found) - squared_error(base), ".2f"),
            _signed(mean_ms(found) - mean_ms(base), ".1f"),
            "; ".join(_changes(found, base)),
        ]
    return "| " + " | ".join(cells) + " |"


def _changes(found: Outcomes, base: Outcomes) -> list[str]:
    """Cases in which wrong poses are believed, or right ones gained or lost, most first."""
    changes = []
    for name, case in found.items():
        here, there = counted(case), counted(base[name])
        right, wrong, ok = (a - b for a, b in zip(here, there, strict=True))
        if right or wrong or ok:
            text = [f"{_signed(n)} {what}" for n, what in ((right, "right"), (ok, "ok"),
                    (wrong, "wrong ok")) if n]  # fmt: skip
            changes.append((10 * abs(wrong) + abs(right) + abs(ok), f"{name}: {', '.join(text)}"))
    return [text for _, text in sorted(changes, reverse=True)[:_MENTIONED]]


def _signed(value: float, form: str = "d") -> str:
    text = format(value, "+" + form)
    return "0" if not float(text) else text.replace("-", "−")


def as_json(found: Outcomes) -> dict[str, Any]:
    """Figures of each case."""
    told = {}
    for name, case in found.items():
        right, wrong, ok = counted(case)
        seen = [one for one in case if one.right]
        told[name] = {
            "frames": len(case),
            "right": right,
            "ok": ok,
            "wrong_ok": wrong,
            "rotation_deg": float(np.median([one.angle_deg for one in seen])) if seen else None,
            "position": float(np.median([one.shift for one in seen])) if seen else None,
            "squared": squared_error({name: case}) if ok else None,
            "ms": mean_ms({name: case}),
        }
    return told

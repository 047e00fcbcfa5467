"""The accuracy table: many runs on all cores, RMS errors, JSON and print."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from rich.console import Console
from rich.table import Table

from paper.pooled import in_order
from paper.published import PUBLISHED
from paper.runs import INDEPENDENT_EVERY, Errors, run
from paper.systems import SCENARIOS, systems

Row: TypeAlias = list[float] | None
Cells: TypeAlias = dict[str, dict[str, dict[str, Row]]]

COLUMNS = (
    "starts",
    "paper",
    "published",
    "independent",
    "matched",
    "oracle",
    "crlb",
    "crlb_prior",
    "ml-from-truth",
)
NUMBERS = ("φ1 °", "φ2 °", "φ3 °", "w1", "w2", "w3")


def collect(runs: int, seed: int, scheduler: str | None = None) -> list[Errors]:
    """Errors of all runs, in order, with a progress bar on a terminal.

    They are computed here on all cores, or on the cluster of a scheduler.
    """
    return in_order(partial(run, seed), range(runs), "runs", scheduler)


def rms_table(results: Sequence[Errors]) -> Cells:
    """RMS errors by system, scenario and estimator, beside the published ones."""
    table: Cells = {}
    for system in systems():
        table[system.name] = {}
        for scenario in SCENARIOS:
            cells = [errors[system.name, scenario.name] for errors in results]
            row: dict[str, Row] = dict.fromkeys(COLUMNS)
            for name in cells[0]:
                values = np.array([cell[name] for cell in cells if name in cell])
                squares = values if name in ("crlb", "crlb_prior") else values**2
                row[name] = [float(x) for x in np.sqrt(squares.mean(axis=0))]
            published = PUBLISHED[system.name].get(scenario.name)
            row["published"] = None if published is None else list(published)
            table[system.name][scenario.name] = row
    return table


def as_json(table: Cells, runs: int, seed: int) -> dict[str, Any]:
    """What `--json` writes."""
    compared = len(range(0, runs, INDEPENDENT_EVERY))
    return {"runs": runs, "seed": seed, "independent_runs": compared, "table": table}


def as_markdown(table: Cells) -> str:
    """A Markdown table per system."""
    lines = []
    for system, scenarios in table.items():
        head = ["scenario", "estimate", *NUMBERS]
        lines += [f"System {system}", "", _markdown_row(head), _markdown_row(["---"] * len(head))]
        for scenario, row in scenarios.items():
            for column in COLUMNS:
                values = row[column]
                if values is not None:
                    lines.append(_markdown_row([scenario, column, *map(_short, values)]))
        lines.append("")
    return "\n".join(lines)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _short(value: float) -> str:
    """Three digits, and no more than six behind the point."""
    return f"{value:.3g}" if value >= 1e-4 else "< 0.0001"


def show(table: Cells, runs: int, console: Console) -> None:
    """Print the table, a block per system and scenario."""
    title = f"RMS errors over {runs} runs (independent: every {INDEPENDENT_EVERY}rd)"
    shown = Table(title=title, title_justify="left")
    shown.add_column("system")
    shown.add_column("scenario")
    shown.add_column("estimate")
    for name in NUMBERS:
        shown.add_column(name, justify="right")
    for system, scenarios in table.items():
        for scenario, row in scenarios.items():
            for column in COLUMNS:
                values = row[column]
                if values is not None:
                    shown.add_row(system, scenario, column, *(f"{x:.4g}" for x in values))
            shown.add_section()
    console.print(shown)

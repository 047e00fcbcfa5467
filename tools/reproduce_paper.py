"""Reproduce the paper's accuracy table and objective maps, beside those of mixpose.

    python tools/reproduce_paper.py [--runs 300] [--seed 0] [--json FILE] [--figures DIR]
                                    [--markdown FILE] [--experiments] [--deformation 0.5 1 2]

`docs/paper.md` says what is compared and why some of it differs.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
from pathlib import Path

# both cores run estimates; threads of the linear algebra within each would only wait
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from paper.table import as_json, as_markdown, collect, rms_table, show
from rich.console import Console


def main() -> None:
    """Run what the options ask for."""
    parser = argparse.ArgumentParser(description="Reproduce the paper's table and figures.")
    parser.add_argument("--runs", type=int, default=300, help="simulation runs per cell")
    parser.add_argument("--seed", type=int, default=0, help="of poses, starts and noise")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table to a file")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw the paper's figures")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write it as Markdown")
    parser.add_argument(
        "--experiments", action="store_true", help="show where printed rows come from, too"
    )
    parser.add_argument(
        "--deformation",
        type=float,
        nargs="+",
        default=[],
        metavar="TIMES",
        help="scenario III at so many times the paper's deformation, too",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a dask.distributed cluster whose workers have this folder in PYTHONPATH; or local",
    )
    options = parser.parse_args()
    complain(parser, options)
    console = Console(width=None if Console().is_terminal else 110)
    table = rms_table(collect(options.runs, options.seed, options.scheduler))
    show(table, options.runs, console)
    result = as_json(table, options.runs, options.seed)
    if options.deformation:
        from paper.deformation import deformation_rows, show_deformation  # noqa: PLC0415

        result["deformation"] = deformation_rows(options.deformation, options.runs, options.seed)
        show_deformation(result["deformation"], options.runs, console)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if options.markdown is not None:
        options.markdown.write_text(as_markdown(table), encoding="utf-8")
    if options.experiments:
        from paper.experiments import run_experiments  # noqa: PLC0415

        run_experiments(options.runs, options.seed, console)
    if options.figures is not None:
        from paper.figures import draw_figures  # noqa: PLC0415

        draw_figures(options.figures, options.seed)


def complain(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Leave with one line on options that would fail after minutes of work."""
    if options.runs < 1:
        parser.error(f"--runs: found {options.runs}, at least 1 is needed")
    for name in ("json", "markdown"):
        path = getattr(options, name)
        if path is not None and not path.absolute().parent.is_dir():
            parser.error(f"--{name}: {path.parent} is no folder; make it first")
    if options.figures is not None and options.figures.is_file():
        parser.error(f"--figures: {options.figures} is a file; name a folder")
    if options.figures is not None and importlib.util.find_spec("matplotlib") is None:
        parser.error("--figures: matplotlib is missing; install mixpose[plots]")


if __name__ == "__main__":
    main()

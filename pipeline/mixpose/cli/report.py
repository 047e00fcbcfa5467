"""``mixpose evaluate`` and ``mixpose report``: poses against the truth, and the page of a run."""

from __future__ import annotations

import json

from mixpose import __version__
from mixpose.cli import output
from mixpose.cli.app import EvaluateRequest, ReportRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.poses.evaluate import evaluate
from mixpose.poses.jsonl import read_poses, read_unfinished_poses
from mixpose.poses.report import as_dict, as_table


def evaluate_poses(request: EvaluateRequest) -> None:
    """Print the errors of poses, as a table or as JSON."""
    files = [read_poses(path) for path in (request.poses, request.truth)]
    errors = evaluate(*files)
    for file in files:
        if file.unit is None and errors.unit is not None:
            warn(f"{file.path}: no header says the unit of its lengths; taken for {errors.unit}")
    text = json.dumps(as_dict(errors), indent=2) if request.json else as_table(errors)
    output.print_lines([text.rstrip("\n")])


def write_report(request: ReportRequest) -> None:
    """Write the report of a run to a page of its own, or to standard output."""
    from mixpose.report.page import MARK, find_session, render  # noqa: PLC0415 - only for pages

    target = request.output
    poses, cut = read_unfinished_poses(request.poses)
    truth = None if request.truth is None else read_poses(request.truth)
    inputs = request.poses, request.truth, find_session(poses).path
    output.refuse_to_overwrite_but(target, inputs, MARK)
    reason = "a report is a page for a browser, which prints a PDF"
    output.refuse_suffix(target, (".html", ".htm"), reason)
    output.write_text(target, render(poses, truth, cut=cut, version=__version__), "-o")
    frames = {line.frame for line in poses.poses}
    say(f"{counted(len(frames), 'frame')} -> {output.shown(target)}")

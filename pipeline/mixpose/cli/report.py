"""``mixpose report``."""

from __future__ import annotations

from mixpose import __version__
from mixpose.cli.app_after import ReportRequest
from mixpose.cli.notices import counted, say
from mixpose.cli.output import refuse_suffix, refuse_to_overwrite_but, shown, write_text
from mixpose.poses.jsonl import read_poses, read_unfinished_poses
from mixpose.report.page import MARK, find_session, render

_PAGES = (".html", ".htm")


def write_report(request: ReportRequest) -> None:
    """Write the report of a run to a page of its own, or to standard output."""
    output = request.output
    poses, cut = read_unfinished_poses(request.poses)
    truth = None if request.truth is None else read_poses(request.truth)
    refuse_to_overwrite_but(output, (request.poses, request.truth, find_session(poses).path), MARK)
    refuse_suffix(output, _PAGES, "a report is a page for a browser, which prints a PDF")
    write_text(output, render(poses, truth, cut=cut, version=__version__), "-o")
    frames = {line.frame for line in poses.poses}
    say(f"{counted(len(frames), 'frame')} -> {shown(output)}")

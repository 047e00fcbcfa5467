"""What a run says in the end about frames that may show the body twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mixpose.cli.findings import Findings
from mixpose.records import Estimate, Status
from mixpose.session import load_session
from mixpose.tracking import TWICE

SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"


@pytest.mark.parametrize("before", [0, 8])
def test_poses_before_the_body_is_seen_twice_may_be_of_its_mirror_image(before: int) -> None:
    session = load_session(SESSION)
    findings = Findings(session)
    for frame in range(20):
        status: Status = "ok" if frame < before else "ambiguous"
        doubt = "" if frame < before else TWICE
        pose, label = np.eye(4), session.labels[0]
        findings.add(Estimate(frame, None, label, status, pose, np.eye(6), 1.0, {}, doubt=doubt))
    (line,) = findings.warnings()
    assert line.startswith(f"{TWICE} in {20 - before} of 20 frames")
    assert line.endswith("is there a mirror?") == (before > 0)

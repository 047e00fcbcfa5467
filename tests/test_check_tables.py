"""What `mixpose check` tells of tables by their rows, times and numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mixpose.checking.recordings import Survey, has_duplicates, numbering_warnings, order_warnings
from mixpose.frames import SourceSpec, open_source


def test_rows_that_are_repeated_and_times_that_go_back_are_told() -> None:
    times = {3: 0.1, 4: 0.2, 5: 0.15}
    own = Survey((3, 4, 5), (3, 4, 5), (4, 4, 4), (), times=times, doubled=(4, 5))
    first, second = order_warnings({"left": own})
    assert "stands twice or more in 2 of 3 frames, as 4: are rows" in first
    assert "'left': frame 5 is at 0.15 s and the frame before it at 0.2 s; a run ends" in second
    assert order_warnings({"left": replace(own, times={3: 0.1, 4: 0.1}, doubled=(4,))}) == []
    assert has_duplicates(np.array([[1.0, 2], [3, 4], [1, 2]]))
    assert not has_duplicates(np.array([[1.0, 2], [3, 4], [1, 3]]))


def test_times_without_numbers_beside_numbers_are_told(tmp_path: Path) -> None:
    for name, column in (("a", "time_s"), ("b", "frame"), ("c", "time_s")):
        (tmp_path / f"{name}.csv").write_text(f"{column},u,v\n0,1,1\n1,2,2\n", encoding="utf-8")
    sources = {
        name: open_source(SourceSpec(name, f"{name}.csv", tmp_path, "camera", fps=30.0))
        for name in "abc"
    }
    first, second = numbering_warnings(sources)
    assert first.startswith("sensor 'a': its table has times and no frame numbers, so that its")
    assert "those of 'b' of the same number; add a column frame" in second
    assert numbering_warnings({name: sources[name] for name in "ac"}) == []
    assert numbering_warnings({"b": sources["b"]}) == []

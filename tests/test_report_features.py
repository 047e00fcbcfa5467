"""How far off each feature is met: in the pose lines, and in the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mixpose.cli import main
from mixpose.poses.jsonl import read_poses
from mixpose.report.series import series_of

SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "poses.jsonl"
    with pytest.raises(SystemExit) as ended:
        main(["run", str(SESSION), "--stop", "4", "-o", str(path)])
    assert not ended.value.code
    return path


def test_pose_lines_tell_how_far_off_each_feature_is_met(poses: Path) -> None:
    line = json.loads(poses.read_text(encoding="utf-8").splitlines()[1])
    for report in line["sensors"].values():
        assert list(report["residuals"]) == [str(k) for k in range(1, 8)]
        met = [each for each in report["residuals"].values() if each is not None]
        assert np.sqrt(np.mean(np.square(met))) == pytest.approx(report["rms"], rel=1e-3)


def test_residuals_are_read_again_with_what_is_not_met_apart(poses: Path) -> None:
    file = read_poses(poses)
    series = series_of(file)

    for name, by_feature in series.residuals.items():
        for feature, values in by_feature.items():
            said = [line.sensors[name].residuals[feature] for line in file.poses]
            assert values.tolist() == [np.inf if each is None else each for each in said]


@pytest.fixture(scope="module")
def page(poses: Path) -> str:
    """A report on them, in which feature 1 is called by what would be a formula."""
    pytest.importorskip("jinja2")
    text = poses.read_text(encoding="utf-8").replace('"1": ', r'"$\\q$": ')
    renamed, output = poses.with_name("renamed.jsonl"), poses.with_name("report.html")
    renamed.write_text(text, encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        main(["report", str(renamed), "-o", str(output)])
    assert not ended.value.code
    return output.read_text(encoding="utf-8")


def test_a_report_shows_each_sensors_features_over_time(page: str) -> None:
    for name in ("left", "right"):
        assert f"{name}: how far off each feature is met over time" in page


def test_a_feature_may_be_called_by_what_would_be_a_formula(page: str) -> None:
    assert r">$\q$<" in page


def test_features_of_lost_frames_and_of_sensors_without_a_frame_are_not_shown(poses: Path) -> None:
    file = read_poses(poses)
    lost, alone, *others = file.poses
    lost = replace(lost, status="lost")
    alone = replace(alone, sensors={"left": alone.sensors["left"]})
    shown = series_of(replace(file, poses=(lost, alone, *others))).residuals
    for name, first in (("left", 1), ("right", 2)):
        values = np.array(list(shown[name].values()))
        assert np.isnan(values).all(axis=0).tolist() == [True] * first + [False] * (4 - first)


def test_frames_that_are_missing_are_left_empty(
    poses: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.axes import Axes

    from mixpose.report import figures

    drawn: list[Any] = []
    draw: Any = Axes.pcolormesh

    def seen(axes: Axes, x: Any, y: Any, cells: Any, **rest: Any) -> Any:
        drawn.append((x, y, cells))
        return draw(axes, x, y, cells, **rest)

    monkeypatch.setattr(Axes, "pcolormesh", seen)
    file = read_poses(poses)
    moved = tuple(
        replace(line, frame=line.frame + 80 * (k > 1), time_s=k + 80.0 * (k > 1))
        for k, line in enumerate(file.poses)
    )
    figures.features(series_of(replace(file, poses=moved)), lambda _: "px")
    x, _, cells = drawn[0]
    assert x.tolist() == [-0.5, 0.5, 1.5, 81.5, 82.5, 83.5]
    assert cells.mask[:, 2].all()  # from 1.5 to 81.5
    assert not cells.mask[:, 3].all()

"""The page: what it says, that it needs nothing else, and that a browser shows it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from command_line import LONGEST_S, command
from report_runs import COVARIANCE, RECORDING, SYNTHETIC, estimate, write, write_run

from mixpose.cli.app import ReportRequest
from mixpose.cli.report import write_report
from mixpose.errors import RecordingError, SessionError
from mixpose.poses.evaluate import evaluate_files
from mixpose.poses.jsonl import read_poses
from mixpose.report.series import series_of

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Page(HTMLParser):
    """Elements and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def ids(self, tag: str) -> list[str | None]:
        return [attrs.get("id") for name, attrs in self.elements if name == tag]

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attrs for name, attrs in self.elements if name == tag]


def report(tmp_path: Path, poses: Path, truth: Path | None = None) -> Page:
    output = tmp_path / "report.html"
    write_report(ReportRequest(poses, output, truth))
    return Page(output.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a whole run against its truth."""
    folder = tmp_path_factory.mktemp("full")
    poses = write_run(folder / "poses.jsonl", {5: "lost", 6: "lost", 7: "lost", 20: "ambiguous"})
    write_report(ReportRequest(poses, folder / "report.html", RECORDING / "truth.jsonl"))
    return folder / "report.html"


def test_page_says_what_became_of_the_frames(full: Path) -> None:
    page = Page(full.read_text(encoding="utf-8"))
    assert "36 ok 1 ambiguous 3 lost" in page.text
    assert "Lost: frames 5–7" in page.text
    assert "Ambiguous: frame 20" in page.text
    assert page.ids("section") == [
        "summary", "errors", "trajectory", "motion", "sensors", "latency", "frames", "session",
    ]  # fmt: skip
    # 2 of errors, 3 planes, 6 of motion, 2 sensors, 1 of latency
    assert len(page.all("svg")) == 14
    assert full.stat().st_size < 3_000_000


def test_a_run_of_one_frame_is_told_as_one(tmp_path: Path) -> None:
    truth = read_poses(RECORDING / "truth.jsonl").poses[10]
    assert truth.T_world_object is not None
    poses = [estimate(10, truth.T_world_object, time_s=0.4)]
    true = write(tmp_path / "truth.jsonl", poses, None)
    page = report(tmp_path, write(tmp_path / "poses.jsonl", poses, None), true)
    assert "frames 1 10 " in page.text
    assert "10 to 10" not in page.text
    assert "1 frame of the truth: 1 ok" in page.text
    assert "Covariance, 1 frame that is ok" in page.text


def test_an_open_turn_has_no_band_and_is_said_to_be_open(tmp_path: Path) -> None:
    # a deviation of 4 rad about x in two of three frames: twice as wide as half a turn
    wide = COVARIANCE + np.diag([0, 0, 0, 16.0, 0, 0])
    lines = [
        replace(estimate(k, np.eye(4)), covariance=wide if k else COVARIANCE) for k in range(3)
    ]
    series = series_of(read_poses(write(tmp_path / "poses.jsonl", lines, None)))
    assert np.isinf(series.half_width[:, 3]).tolist() == [False, True, True]
    assert np.isfinite(series.half_width[:, [0, 1, 2, 4, 5]]).all()
    page = report(tmp_path, tmp_path / "poses.jsonl")
    spoken = [str(each.get("aria-label") or each.get("alt")) for _, each in page.elements]
    said = [text for text in spoken if "open in 2 of 3 frames" in text]
    assert len(said) == 1
    assert said[0].startswith("Turn about x, deg")
    assert "open in 2 frames" in page.text


def test_page_has_the_figures_of_evaluate(full: Path) -> None:
    page = Page(full.read_text(encoding="utf-8"))
    found = evaluate_files(full.with_name("poses.jsonl"), RECORDING / "truth.jsonl")
    assert found.rotation_deg is not None
    assert found.translation is not None
    assert found.nees is not None
    for spread, name in (
        (found.rotation_deg, "rotation, deg"),
        (found.translation, "position, mm"),
    ):
        row = f"{name} {spread.rms:.4g} {spread.median:.4g} {spread.p95:.4g} {spread.max:.4g}"
        assert row in page.text
    assert f"squared error per dimension {found.nees.mean_per_dimension:.3g}" in page.text


def test_page_shows_the_session_and_frames_of_both_cameras(full: Path) -> None:
    page = Page(full.read_text(encoding="utf-8"))
    assert "# Two cameras at about right angles see seven markers" in page.text
    assert "unchanged since the run" in page.text
    shown = [attrs["alt"] for attrs in page.all("img")]
    assert "Frame 5 of left" in shown
    assert "Frame 39 of right with the pose drawn on it" in shown
    assert len(shown) >= 2 * 5


def test_page_names_nothing_outside_itself(full: Path) -> None:
    text = full.read_text(encoding="utf-8")
    places = [
        value or ""
        for _, attrs in Page(text).elements
        for key, value in attrs.items()
        if key in ("src", "href", "xlink:href", "srcset", "action", "data")
    ]
    assert places
    assert {place[:5] for place in places if not place.startswith("#")} == {"data:"}
    assert set(re.findall(r"url\((.)", text)) <= {"#"}
    assert "@import" not in text
    assert "http://" not in text
    assert "https://" not in text
    assert "default-src 'none'" in text


def test_figures_refer_to_parts_of_themselves_only(full: Path) -> None:
    text = full.read_text(encoding="utf-8")
    everywhere: list[str] = []
    for figure in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        defined = re.findall(r'\bid="([^"]*)"', figure)
        used = re.findall(r'url\(#([^)]*)\)|href="#([^"]*)"', figure)
        assert used
        assert {a or b for a, b in used} <= set(defined)
        everywhere += defined
    assert len(everywhere) == len(set(everywhere))


# Put into the page: tells the page around it what has become of it.
WITHIN = """<script>
  const blocked = [];
  document.addEventListener("securitypolicyviolation", e => blocked.push(e.blockedURI));
  addEventListener("load", () => parent.postMessage({
    text: document.body.innerText,
    title: document.title,
    scripts: document.scripts.length,
    images: [...document.images].map(i => i.naturalWidth),
    figures: [...document.querySelectorAll("main svg")].map(
      s => Math.round(s.getBoundingClientRect().width)),
    resources: performance.getEntriesByType("resource").map(r => r.name.slice(0, 5)),
    blocked: blocked,
    width: innerWidth,
    needed: document.documentElement.scrollWidth,
  }, "*"));
</script></head>"""
# A window cannot be as narrow as a telephone, but a frame in it can.
AROUND = """<body><iframe src="copy.html" width="{}" height="900" style="border: 0"></iframe>
<script>addEventListener("message", e => {{
  document.body.dataset.answers = encodeURIComponent(JSON.stringify(e.data));
}});</script>"""


def browse(page: Path, tmp_path: Path, width: int) -> dict[str, Any]:
    """What a browser makes of a page of a width in px."""
    text = page.read_text(encoding="utf-8").replace("</head>", WITHIN, 1)
    text = text.replace("default-src 'none'", "default-src 'none'; script-src 'unsafe-inline'", 1)
    (tmp_path / "copy.html").write_text(text, encoding="utf-8")
    around = tmp_path / "around.html"
    around.write_text(AROUND.format(width), encoding="utf-8")
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
        "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", f"--user-data-dir={tmp_path / 'browser'}", "--window-size=1700,1000",
        "--virtual-time-budget=5000", "--dump-dom", around.as_uri(),
    ]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LONGEST_S)
    found = re.search(r'data-answers="([^"]*)"', result.stdout)
    assert found is not None, result.stderr
    answers: dict[str, Any] = json.loads(unquote(found.group(1)))
    answers["text"] = " ".join(answers["text"].split())
    return answers


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed")
@pytest.mark.parametrize("width", [400, 1600])
def test_a_browser_shows_every_figure_and_asks_for_nothing(
    full: Path, tmp_path: Path, width: int
) -> None:
    answers = browse(full, tmp_path, width)
    assert answers["width"] == width
    for words in (
        "two_cameras/session.toml",
        "36 ok 1 ambiguous 3 lost",
        "Errors against the truth",
        "Trajectory",
        "Turn about z, deg",
        "explained, median",
        "Time per frame",
        "smallest rotation error",
        "# Two cameras at about right angles",
    ):
        assert words in answers["text"]
    assert len(answers["images"]) >= 10
    assert min(answers["images"]) >= 120
    assert len(answers["figures"]) == 14
    assert min(answers["figures"]) >= 300  # px: below it the words in figures cannot be read
    assert set(answers["resources"]) <= {"data:"}
    assert answers["blocked"] == []
    assert answers["needed"] <= width  # nobody has to scroll sideways


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed")
def test_a_browser_runs_nothing_that_names_in_a_file_hold(tmp_path: Path) -> None:
    evil = "<img src=x onerror=\"document.title='taken'\"><script>document.title='taken'</script>"
    estimates = [estimate(n, np.eye(4), object=evil, sensors=(f"{evil}$x_",)) for n in range(2)]
    output = tmp_path / "report.html"
    poses = write(tmp_path / "p.jsonl", estimates, None)
    header, *lines = poses.read_text(encoding="utf-8").splitlines()
    header = json.dumps({**json.loads(header), "session": evil, "mixpose": evil, "seed": evil})
    poses.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    write_report(ReportRequest(poses, output))
    answers = browse(output, tmp_path, 800)
    assert answers["images"] == []
    assert answers["scripts"] == 1  # the one put in here
    assert answers["title"] != "taken"
    assert answers["text"].count("document.title='taken'") >= 8  # as words: twice in each name


def test_unfinished_run_is_reported_up_to_its_last_whole_line(tmp_path: Path) -> None:
    estimates = [estimate(n, np.eye(4), "lost") for n in range(3)]
    poses = write(tmp_path / "p.jsonl", estimates, None)
    poses.write_bytes(poses.read_bytes()[:-40])
    page = report(tmp_path, poses)
    assert "0 ok 0 ambiguous 2 lost" in page.text
    assert "The last line of the poses file is cut off" in page.text
    assert "Every frame is lost" in page.text
    with pytest.raises(RecordingError, match="cut off"):
        read_poses(poses)


def test_run_without_a_frame_yet_and_file_without_header_say_so(tmp_path: Path) -> None:
    page = report(tmp_path, write(tmp_path / "p.jsonl", [], None))
    assert "The poses file holds no frame." in page.text
    bare = tmp_path / "bare.jsonl"
    lost = {"frame": 3, "object": "a", "status": "lost", "T_world_object": None}
    bare.write_text(json.dumps(lost) + "\n", encoding="utf-8")
    page = report(tmp_path, bare)
    assert "has no header, so unit, session and symmetries are not known" in page.text
    assert "names no session file" in page.text
    assert "0 ok 0 ambiguous 1 lost" in page.text


def test_changed_session_is_shown_with_a_warning_and_no_frames(tmp_path: Path) -> None:
    session = tmp_path / "session.toml"
    shutil.copy(RECORDING / "session.toml", session)
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], session, "0" * 64)
    page = report(tmp_path, poses)
    assert "has changed since the run" in page.text
    assert "seven markers on a body" in page.text
    assert page.all("img") == []


def test_session_that_is_gone_is_named(tmp_path: Path) -> None:
    gone = tmp_path / "gone.toml"
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], gone, "0" * 64)
    page = report(tmp_path, poses)
    assert f"The session file {gone} is missing" in page.text


def test_session_that_moved_with_the_poses_is_known_by_its_hash(tmp_path: Path) -> None:
    poses = write_run(tmp_path / "p.jsonl", dict.fromkeys(range(40), "lost"))
    text = poses.read_text(encoding="utf-8")
    assert str(RECORDING) in text
    poses.write_text(text.replace(str(RECORDING), "elsewhere"), encoding="utf-8")
    shutil.copy(RECORDING / "session.toml", tmp_path)
    shutil.copy(RECORDING / "left0000.png", tmp_path)
    page = report(tmp_path, poses)
    assert f"{tmp_path / 'session.toml'}, unchanged since the run" in page.text
    assert "The recording of right cannot be read again" in page.text
    assert [attrs["alt"] for attrs in page.all("img")] == ["Frame 0 of left"]


def test_a_file_that_is_no_session_is_never_put_into_the_page(tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("password = 'swordfish'\n", encoding="utf-8")
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], secret, "0" * 64)
    page = report(tmp_path, poses)
    assert "is no session file now" in page.text
    assert "swordfish" not in page.text


def test_frames_of_a_video_are_read_again(tmp_path: Path) -> None:
    session = SYNTHETIC / "one_camera_video" / "session.toml"
    estimates = [estimate(n, np.eye(4), "lost", sensors=()) for n in (3, 9)]
    page = report(tmp_path, write(tmp_path / "p.jsonl", estimates, session))
    assert [attrs["alt"] for attrs in page.all("img")] == ["Frame 3 of camera", "Frame 9 of camera"]


def test_output_never_takes_the_place_of_something_else(tmp_path: Path) -> None:
    truth = tmp_path / "truth.jsonl"
    shutil.copy(RECORDING / "truth.jsonl", truth)
    session = tmp_path / "session.toml"
    shutil.copy(RECORDING / "session.toml", session)
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], session)
    other = tmp_path / "notes.html"
    other.write_text("<!DOCTYPE html>\n<title>mine</title>\n", encoding="utf-8")
    before = {path: path.read_bytes() for path in (poses, truth, session, other)}
    for output, words in (
        (poses, "is an input"),
        (truth, "is an input"),
        (session, "is an input"),
        (other, "did not write"),
        (tmp_path, "is a folder"),
        (tmp_path / "none" / "report.html", "there is no folder"),
    ):
        with pytest.raises(SessionError, match=words):
            write_report(ReportRequest(poses, output, truth))
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.usefixtures("without_plots")
def test_frames_of_several_bodies_are_counted_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = [estimate(k, np.eye(4), object=name) for k in range(3) for name in ("tool", "cup")]
    report(tmp_path, write(tmp_path / "p.jsonl", both, None))
    assert "3 frames -> " in capsys.readouterr().err


def test_a_report_replaces_an_earlier_report(tmp_path: Path) -> None:
    first = report(tmp_path, write(tmp_path / "p.jsonl", [], None))
    second = report(tmp_path, write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], None))
    assert "0 lost" in first.text
    assert "1 lost" in second.text


@pytest.mark.parametrize("library", ["jinja2", "matplotlib"])
def test_missing_library_is_named_with_the_extra_that_brings_it(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = write(tmp_path / "p.jsonl", [], None)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(SessionError, match=rf"found no {library}.*mixpose\[report\]"):
        write_report(ReportRequest(poses, tmp_path / "report.html"))
    assert not (tmp_path / "report.html").exists()


def test_command_line_writes_the_page_and_says_where(tmp_path: Path) -> None:
    poses = write(tmp_path / "p.jsonl", [estimate(0, np.eye(4), "lost")], None)
    output = tmp_path / "r.html"
    result = command("report", poses, "-o", output)
    assert (result.returncode, result.stdout) == (0, "")
    assert result.stderr == f"mixpose: 1 frame -> {output}\n"
    assert output.stat().st_size > 5000
    result = command("report", tmp_path / "absent.jsonl", "-o", output)
    assert result.returncode == 3
    assert len(result.stderr.splitlines()) == 1

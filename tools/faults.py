"""Recordings with faults, what becomes of their frames, and what the run says of it.

    python tools/faults.py [FAULT ...] [--markdown]

Each fault is put into a copy of the recording of two cameras in `data/synthetic/` (40 frames, seven
markers), or into its session.  A pose counts as wrong where it is ok and more than `WRONG_DEG` or
`WRONG_MM` from the truth.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.checking import shared_source_warnings
from mixpose.cli.notices import Summary
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, Floats, Mask
from mixpose.rigid import from_rotation_vector, inverse, rotation_angle_deg
from mixpose.runner import run
from mixpose.selection import Selection
from mixpose.session import load_session

RECORDING = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras"
FRAMES = range(40)
WRONG_DEG, WRONG_MM = 1.0, 1.0

Change: TypeAlias = Callable[[Path], None]


def image(folder: Path, side: str, frame: int) -> Path:
    return folder / f"{side}{frame:04d}.png"


def redrawn(side: str, frames: range, draw: Callable[[Floats], Floats]) -> Change:
    """Images of a camera drawn anew."""

    def change(folder: Path) -> None:
        for frame in frames:
            path = image(folder, side, frame)
            before = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert before is not None
            cv2.imwrite(str(path), draw(before.astype(np.float64)).astype(np.uint8))

    return change


def instead(side: str, frames: range, other: Callable[[int], int]) -> Change:
    """Frames of a camera that show what another frame shows."""

    def change(folder: Path) -> None:
        kept = {frame: image(folder, side, other(frame)).read_bytes() for frame in frames}
        for frame, content in kept.items():
            image(folder, side, frame).write_bytes(content)

    return change


def missing(side: str, frames: range) -> Change:
    def change(folder: Path) -> None:
        for frame in frames:
            image(folder, side, frame).unlink()

    return change


def torn(side: str, frames: range) -> Change:
    """Images whose lower half is of the next frame."""

    def change(folder: Path) -> None:
        images = {
            frame: cv2.imread(str(image(folder, side, frame)), cv2.IMREAD_GRAYSCALE)
            for frame in range(frames.start, frames.stop + 3)
        }
        for frame in frames:
            picture = np.array(images[frame])
            half = len(picture) // 2
            picture[half:] = np.array(images[frame + 3])[half:]
            cv2.imwrite(str(image(folder, side, frame)), picture)

    return change


def turn(axis: str, degrees: float) -> Floats:
    """A turn about x (across, to the right), y (down) or z (the line of sight) of a camera."""
    angles = np.radians(degrees) * np.eye(3)["xyz".index(axis)]
    return np.asarray(from_rotation_vector(angles, [0, 0, 0]))


def bumped(side: str, frames: range, degrees: float, axis: str) -> Change:
    """A camera that has turned about an axis of its own: its images, seen through a homography."""

    def change(folder: Path) -> None:
        setup = next(s for s in load_session(folder / "session.toml").sensors if s.name == side)
        K = setup.sensor.camera_matrix  # type: ignore[attr-defined]
        R = turn(axis, degrees)[:3, :3]
        H = K @ R @ np.linalg.inv(K)
        size = setup.resolution
        assert size is not None

        def turned(before: Floats) -> Floats:
            return np.asarray(cv2.warpPerspective(before, H, size, flags=cv2.INTER_CUBIC), float)

        redrawn(side, frames, turned)(folder)

    return change


def rewritten(*pairs: tuple[str, str]) -> Change:
    """A session that says something else."""

    def change(folder: Path) -> None:
        path = folder / "session.toml"
        text = path.read_text(encoding="utf-8")
        for pattern, new in pairs:
            text, count = re.subn(pattern, new, text, flags=re.MULTILINE)
            if not count:
                raise RuntimeError(f"{pattern} is not in the session")
        path.write_text(text, encoding="utf-8")

    return change


def points(changed: Callable[[Floats], Floats]) -> Change:
    """A body whose points are others than those that were recorded."""

    def change(folder: Path) -> None:
        body = load_session(folder / "session.toml").body
        rows = ", ".join(str(row) for row in changed(body.means.copy()).tolist())
        rewritten((r"points = \[\n(.*\n)*?\]", f"points = [{rows}]"))(folder)

    return change


def moved(number: int, by: tuple[float, float, float]) -> Change:
    def shift(means: Floats) -> Floats:
        means[number] += by
        return means

    return points(shift)


def gone(means: Floats) -> Floats:
    """One more marker than the recording shows."""
    return np.concatenate([means, [[-30.0, 40.0, -70.0]]])


NO_START: Change = rewritten((r"\[start\]\n.*\n.*\n", ""))


def both(*changes: Change) -> Change:
    def change(folder: Path) -> None:
        for each in changes:
            each(folder)

    return change


@dataclass(frozen=True)
class Fault:
    """What is wrong with a recording, and what names it.

    Attributes
    ----------
    change : callable
        Puts it into a folder.
    named : str
        Regular expression that one of the warnings in the end must hold; empty: none is needed.
    has_truth : bool
        Whether any pose can be right.
    """

    change: Change
    named: str = ""
    has_truth: bool = True


def inverted(*sides: str) -> Change:
    """Cameras of which the session gives their own poses in the world."""

    def change(folder: Path) -> None:
        for setup in load_session(folder / "session.toml").sensors:
            if setup.name not in sides:
                continue
            T = inverse(setup.sensor.T_sensor_world)  # type: ignore[attr-defined]
            rows = ", ".join(str(row) for row in T.tolist())
            old = rf'(name = "{setup.name}"\n(?:.*\n)*?)rotation_vector = .*\ntranslation = .*\n'
            rewritten((old, rf"\g<1>T_sensor_world = [{rows}]\n"))(folder)

    return change


FAULTS: dict[str, Fault] = {
    "nothing": Fault(lambda folder: None),
    "frames missing": Fault(missing("right", range(10, 16)), "'right' .*no frame.* 10 to 15"),
    "sensor drops out and returns": Fault(
        missing("right", range(8, 30)), "'right' .*no frame.* 8 to 29"
    ),
    "frame doubled": Fault(instead("right", range(20, 21), lambda k: k - 1), "'right' .*20"),
    "frozen for 5 frames": Fault(instead("right", range(10, 15), lambda k: 9), "'right' .*froz"),
    "frozen for 20 frames": Fault(instead("right", range(10, 30), lambda k: 9), "'right' .*froz"),
    "black for 5 frames": Fault(
        redrawn("right", range(10, 15), lambda a: 0 * a), "'right' .*no feature.* 10 to 14"
    ),
    "black all along": Fault(redrawn("right", FRAMES, lambda a: 0 * a), "'right' .*no feature"),
    "saturated for 5 frames": Fault(
        redrawn("right", range(10, 15), lambda a: 0 * a + 255), "'right' .*no feature.* 10 to 14"
    ),
    "torn for 5 frames": Fault(torn("right", range(10, 15)), "'right' .*"),
    "one frame late": Fault(
        instead("right", range(1, 40), lambda k: k - 1), "'right' is a frame late"
    ),
    **{
        f"bumped by {degrees}° about {axis} from frame 20": Fault(
            bumped("right", range(20, 40), degrees, axis), "from frame 20 on.*bumped"
        )
        for axis in "xyz"
        for degrees in (0.5, 3)
    },
    "mirrored image": Fault(redrawn("right", FRAMES, lambda a: a[:, ::-1]), "'right'|mirror"),
    "another camera's calibration": Fault(
        rewritten(
            (
                r"camera_matrix = \[\[812.4, 0.0, 322.7\], \[0.0, 811.9",
                "camera_matrix = [[912.4, 0.0, 322.7], [0.0, 911.9",
            )
        ),
        "calibration",
    ),
    "left and right swapped": Fault(
        rewritten(
            (r'source = "left\*.png"', 'source = "x*.png"'),
            (r'source = "right\*.png"', 'source = "left*.png"'),
            (r'source = "x\*.png"', 'source = "right*.png"'),
        ),
        "swapped",
    ),
    "left and right swapped, no start": Fault(
        both(
            NO_START,
            rewritten(
                (r'source = "left\*.png"', 'source = "x*.png"'),
                (r'source = "right\*.png"', 'source = "left*.png"'),
                (r'source = "x\*.png"', 'source = "right*.png"'),
            ),
        ),
        "swapped",
    ),
    "points in metres": Fault(both(NO_START, points(lambda m: m / 1000)), "unit", False),
    "translations in metres": Fault(
        both(
            NO_START,
            rewritten(
                (r"translation = \[14.0, -9.0, 780.0\]", "translation = [0.014, -0.009, 0.78]"),
                (r"translation = \[-11.0, 6.0, 820.0\]", "translation = [-0.011, 0.006, 0.82]"),
            ),
        ),
        "unit",
        False,
    ),
    "T_sensor_world inverted": Fault(
        both(NO_START, inverted("left", "right")), "T_sensor_world.*inverted", has_truth=False
    ),
    "T_sensor_world of one inverted": Fault(
        both(NO_START, inverted("right")), "T_sensor_world of 'right' is inverted"
    ),
    "body 5 % too large": Fault(
        points(lambda m: 1.05 * m), "0.952 times as large", has_truth=False
    ),
    "body 1 % too small": Fault(points(lambda m: 0.99 * m), "1.01 times as large"),
    "one camera's files given for both": Fault(
        rewritten((r'source = "right\*.png"', 'source = "left*.png"')), "same recording"
    ),
    "marker gone": Fault(points(gone), "marker 8 .*gone"),
    "marker falls off": Fault(lambda folder: fallen(folder, 4, range(20, 40)), "marker 5 .*gone"),
    "marker moves on the body": Fault(
        lambda folder: fallen(folder, 3, range(20, 40), (1.2, 0.0, 1.6)),
        "marker 4 is met 2 mm off from frame 20 on.*moved",
    ),
    "marker measured 20 mm wrong": Fault(moved(3, (12.0, 0.0, 16.0)), "marker 4 .*measured wrong"),
    "marker measured 2 mm wrong": Fault(moved(3, (1.2, 0.0, 1.6)), "marker 4 .*measured wrong"),
    "body mirrored": Fault(
        both(NO_START, points(lambda m: m * [1, 1, -1])), "mirrored", has_truth=False
    ),
}


def fallen(
    folder: Path, number: int, frames: range, onto: tuple[float, float, float] | None = None
) -> None:
    """Paint over a marker, and what was there where it is once it has moved by `onto`."""
    session = load_session(folder / "session.toml")
    truth = {line.frame: line.T_world_object for line in read_poses(folder / "truth.jsonl").poses}
    before = session.body.means[number]
    for setup in session.sensors:
        for frame in frames:
            T = truth[frame]
            assert T is not None
            places = np.array([before, before + (onto or 0.0)]) @ T[:3, :3].T + T[:3, 3]
            place, after = setup.sensor.project(places)[0]
            path = image(folder, setup.name, frame)
            picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert picture is not None
            by = np.column_stack([np.eye(2), after - place]).astype(np.float32)
            size = (picture.shape[1], picture.shape[0])
            moved = cv2.warpAffine(picture, by, size, flags=cv2.INTER_CUBIC)
            picture[_spot_at(place, picture)] = int(np.median(picture))
            if onto is not None:
                there = _spot_at(after, picture)
                picture[there] = moved[there]
            cv2.imwrite(str(path), picture)


def _spot_at(place: Floats, picture: NDArray[Any]) -> Mask:
    """Which pixels of a picture a marker may cover."""
    centre = round(float(place[0])), round(float(place[1]))
    return cv2.circle(np.zeros(picture.shape, np.uint8), centre, 9, 1, -1) > 0


@dataclass(frozen=True)
class Result:
    """What became of a recording with a fault."""

    right: int
    wrong: int
    ambiguous: int
    lost: int
    said: list[str]
    is_named: bool


def outcome(fault: Fault, folder: Path, stop: int | None = None) -> Result:
    """Run a copy of the recording with a fault in it, or its first frames."""
    shutil.copytree(RECORDING, folder)
    fault.change(folder)
    truth = {line.frame: line.T_world_object for line in read_poses(folder / "truth.jsonl").poses}
    session = load_session(folder / "session.toml")
    summary = Summary(session)
    counts = {"right": 0, "wrong": 0, "ambiguous": 0, "lost": 0}
    for estimate in run(session, selection=Selection(stop=stop), watch=summary.findings.watch):
        summary.add(estimate)
        if estimate.status != "ok":
            counts[estimate.status] += 1
        else:
            counts["right" if fault.has_truth and is_right(estimate, truth) else "wrong"] += 1
    said = [*shared_source_warnings(session, {}), *summary.warnings()]
    is_named = any(re.search(fault.named, line) for line in said) if fault.named else not said
    return Result(**counts, said=said, is_named=is_named)


def is_right(estimate: Estimate, truth: dict[int, Floats | None]) -> bool:
    T, right = estimate.T_world_object, truth[estimate.frame]
    assert T is not None
    assert right is not None
    turned = float(rotation_angle_deg(T, right))
    return turned < WRONG_DEG and float(np.linalg.norm(T[:3, 3] - right[:3, 3])) < WRONG_MM


def main() -> int:
    parser = argparse.ArgumentParser(description="What becomes of recordings with faults.")
    parser.add_argument("faults", nargs="*", help=", ".join(FAULTS).replace("%", "%%"))
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    unknown = {*options.faults} - {*FAULTS}
    if unknown:
        parser.error(f"no such fault: {sorted(unknown)[0]}")
    print("| fault | ok and right | ambiguous | lost | wrong | named |")
    print("| --- | --- | --- | --- | --- | --- |")
    good = True
    for name in options.faults or FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            found = outcome(FAULTS[name], Path(folder) / "recording")
        good &= found.is_named and not found.wrong
        words = " / ".join(found.said) or "nothing"
        print(
            f"| {name} | {found.right} | {found.ambiguous} | {found.lost} | {found.wrong} | "
            f"{'yes' if found.is_named else 'NO'}: {words} |",
            flush=True,
        )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

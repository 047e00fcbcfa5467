"""How mixpose bears errors that are no independent noise: cut and merged spots, bad calibrations.

python tools/real_errors.py [CASE ...] [--seeds 5] [--workers 2] [--json FILE]

Recordings are made by `mixpose simulate`; then an arm is painted over their images, or the session
is changed so that it no longer tells the truth.  Beside the errors of mixpose stand those of robust
least squares (`scipy.optimize.least_squares`, soft_l1) on the same detections, told which detection
is whose by the true pose, and whether the covariance holds.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from benchmarks.recordings import MARKERS
from benchmarks.search_cases import looking_at
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import mixpose
from mixpose.frames import read_image
from mixpose.objective import View
from mixpose.poses.evaluate import normalised_error_squared
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, FrameSet, PointPattern
from mixpose.rigid import perturb, rotation_angle_deg, transform, twist_between
from mixpose.simulation import SimulationOptions, simulate

Floats: TypeAlias = NDArray[np.float64]
Change: TypeAlias = Callable[[Path, int], None]

INSIDE_95 = 12.592  # χ² of six
WRONG = 20.0  # standard deviations of a dimension, and
WRONG_DEG, WRONG_MM = 3.0, 15.0  # from which a pose called ok is a wrong one
KNOWN_PX, SCALE_PX = 8.0, 0.05  # how far a detection may be off, and what is much for the oracle
EYES = ([0.0, -1.0, 0.0], [1.0, 0.0, 0.0])
BOARD = [[25.0 * i, 25.0 * j, 0.0] for i in range(6) for j in range(5)]
SPOTS = SimulationOptions(40, noise=1.0, spot_sigma=4.0, period_s=3.0)
TABLE = SimulationOptions(40, pixel_noise=0.05, clutter=2, hidden=0.1)


@dataclass(frozen=True)
class Case:
    """A body before cameras, and what is wrong.

    Attributes
    ----------
    options : SimulationOptions
    cameras : int
    distance : float
    points : list
    images : bool
        Whether frames are images, not tables of detections.
    change : callable or None
        What is done to a finished recording.
    focal : float
    """

    options: SimulationOptions
    cameras: int = 2
    distance: float = 1000.0
    points: tuple[tuple[float, ...], ...] = tuple(map(tuple, MARKERS))
    images: bool = True
    change: Change | None = None
    focal: float = 900.0


@dataclass(frozen=True)
class Figures:
    """RMS errors in degrees and length units of mixpose and of the oracle, and the covariance."""

    rotation_deg: float
    position: float
    oracle_deg: float
    oracle_position: float
    squared: float
    inside: float
    ok: float
    wrong: int


def arm(folder: Path, seed: int) -> None:
    """Paint a dark arm over all images, which sweeps across them."""
    rng = np.random.default_rng([seed, 7])
    for camera in range(2):
        angle, speed = rng.uniform(0, np.pi), rng.uniform(5, 9)
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        for k, path in enumerate(sorted(folder.glob(f"c{camera}_*.png"))):
            image = read_image(path)
            middle = np.array([319.5, 255.5]) + across * (speed * (k - 20))
            mask = np.zeros_like(image)
            ends = [tuple(np.round(16 * (middle + s * 900 * along)).astype(int)) for s in (-1, 1)]
            cv2.line(mask, ends[0], ends[1], 255, 24, cv2.LINE_AA, 4)
            share = cv2.GaussianBlur(mask, (0, 0), 1.0).astype(np.float64) / 255
            dark = 10 + rng.normal(0, 1, image.shape)
            cv2.imwrite(str(path), np.clip(image + share * (dark - image) + 0.5, 0, 255))


def turned(folder: Path, seed: int) -> None:
    """Turn the last camera by 0.1° after its calibration, about any axis."""
    axis = np.random.default_rng([seed, 9]).normal(size=3)
    turn = Rotation.from_rotvec(0.1 * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    _changed(folder, lambda T: np.vstack([turn @ T[:3], T[3]]))


def _changed(folder: Path, change: Callable[[Floats], Floats]) -> None:
    lines = (folder / "session.toml").read_text(encoding="utf-8").splitlines()
    k = max(k for k, line in enumerate(lines) if line.startswith("T_sensor_world"))
    T = np.array(json.loads(lines[k].split("=")[1]))
    lines[k] = f"T_sensor_world = {change(T).tolist()}"
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def bad_lens(folder: Path, seed: int) -> None:
    """Tell the session another principal point, focal length and distortion than there were."""
    path = folder / "session.toml"
    text = path.read_text(encoding="utf-8")
    text = text.replace(
        "[[900.0, 0, 319.5], [0, 900.0, 255.5]", "[[900.4, 0, 319.9], [0, 900.2, 255.2]"
    )
    path.write_text(text.replace("distortion = [0.0,", "distortion = [0.002,"), encoding="utf-8")


def bad_body(folder: Path, seed: int) -> None:
    """Tell the session markers that are off by 0.1 mm."""
    path = folder / "session.toml"
    off = np.array(MARKERS) + np.random.default_rng([seed, 8]).normal(0, 0.1, (len(MARKERS), 3))
    text = path.read_text(encoding="utf-8").replace(
        f"points = {MARKERS}", f"points = {off.tolist()}"
    )
    path.write_text(text, encoding="utf-8")


_flat = tuple(map(tuple, BOARD))
CASES = {
    "ideal": Case(replace(SPOTS, spot_sigma=1.6)),
    "one camera": Case(replace(SPOTS, spot_sigma=1.6), cameras=1),
    "large spots that merge": Case(replace(SPOTS, spot_sigma=6.0, amplitude_rotation_deg=60)),
    "far spots that merge": Case(replace(SPOTS, spot_sigma=2.0), distance=5000.0),
    "cut by the edge": Case(replace(SPOTS, amplitude_translation=230.0, period_s=2.0)),
    "arm in front": Case(SPOTS, change=arm),
    "turned camera": Case(TABLE, images=False, change=turned),
    "bad lens": Case(TABLE, images=False, change=bad_lens),
    "bad lens, one camera": Case(TABLE, images=False, cameras=1, points=_flat, change=bad_lens),
    "bad lens, board": Case(TABLE, images=False, points=_flat, change=bad_lens),
    "bad body": Case(TABLE, images=False, change=bad_body),
}


def figures_of(name: str, seed: int) -> Figures:
    """Make a recording with a seed, estimate it, and compare."""
    case = CASES[name]
    with tempfile.TemporaryDirectory() as scratch:
        draft, folder = Path(scratch) / "draft.toml", Path(scratch) / "made"
        draft.write_text(_session_text(case), encoding="utf-8")
        simulate(mixpose.load_session(draft), folder, replace(case.options, seed=seed))
        if case.change:
            case.change(folder, seed)
        return _compared(folder)


def _session_text(case: Case) -> str:
    turn = Rotation.from_euler("xyz", [0.2, -0.3, 0.4]).as_rotvec().tolist()
    lines = [
        'unit = "mm"', "[object]", 'name = "body"', f"points = {[list(p) for p in case.points]}",
        "[start]", f"rotation_vector = {turn}", "translation = [0, 0, 0]",
        "rotation_deg = 10", "distance = 20",
    ]  # fmt: skip
    for k, eye in enumerate(EYES[: case.cameras]):
        T = looking_at(case.distance * np.array(eye), np.zeros(3))
        f = case.focal
        lines += [
            "[[sensor]]", f'name = "c{k}"', 'model = "pinhole"',
            f'source = "{f"c{k}_*.png" if case.images else f"c{k}.csv"}"',
            "fps = 25.0", "resolution = [640, 512]",
            f"camera_matrix = [[{f}, 0, 319.5], [0, {f}, 255.5], [0, 0, 1]]",
            "distortion = [0.0, 0.0, 0.0, 0.0]", f"T_sensor_world = {T.tolist()}",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _compared(folder: Path) -> Figures:
    session = mixpose.load_session(folder / "session.toml")
    truth = {one.frame: one.T_world_object for one in read_poses(folder / "truth.jsonl").poses}
    rows: list[tuple[float, ...]] = []
    count = 0

    def watch(frames: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        nonlocal count
        count += 1
        T_true = truth[estimate.frame]
        assert T_true is not None
        if estimate.status != "ok" or estimate.T_world_object is None:
            return
        T = estimate.T_world_object
        assert estimate.covariance is not None
        total, dimensions = normalised_error_squared(twist_between(T_true, T), estimate.covariance)
        known = robust_least_squares(views, session.body.means, T_true)
        rows.append((*_errors(T, T_true), *_errors(known, T_true), total or np.inf, dimensions))

    for _ in mixpose.run(session, watch=watch):
        pass
    found = np.array(rows).reshape(-1, 6)
    rms = np.sqrt((found[:, :4] ** 2).mean(axis=0)) if len(found) else np.full(4, np.nan)
    off = (found[:, 0] > WRONG_DEG) | (found[:, 1] > WRONG_MM)
    return Figures(
        rotation_deg=float(rms[0]),
        position=float(rms[1]),
        oracle_deg=float(rms[2]),
        oracle_position=float(rms[3]),
        squared=float((found[:, 4] / found[:, 5]).mean()),
        inside=float((found[:, 4] < INSIDE_95).mean()),
        ok=len(found) / count,
        wrong=int((off & (found[:, 4] > WRONG**2)).sum()),
    )


def _errors(T: Floats, T_true: Floats) -> tuple[float, float]:
    shift = float(np.linalg.norm(T[:3, 3] - T_true[:3, 3]))
    return float(rotation_angle_deg(T, T_true)), shift


def robust_least_squares(views: Sequence[View], points: Floats, T_true: Floats) -> Floats:
    """The pose (4, 4) by robust least squares, where it is known which detection is whose."""
    pairs = []
    for view in views:
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        y, seen = view.sensor.project(transform(T_true, points))
        if not len(pattern.points):
            continue
        apart = np.linalg.norm(pattern.points - y[:, None], axis=2)
        nearest = apart.argmin(axis=1)
        mine = seen & (apart.min(axis=1) < KNOWN_PX)
        mine &= apart[:, nearest].argmin(axis=0) == np.arange(len(y))
        pairs.append((view.sensor, points[mine], pattern.points[nearest[mine]]))

    def residuals(twist: Floats) -> Floats:
        T = perturb(T_true, twist * np.repeat([1.0, 0.01], 3))
        return np.concatenate([(s.project(transform(T, p))[0] - y).ravel() for s, p, y in pairs])

    found = least_squares(residuals, np.zeros(6), loss="soft_l1", f_scale=SCALE_PX, xtol=1e-12)
    return perturb(T_true, found.x * np.repeat([1.0, 0.01], 3))


def line_of(name: str, found: Sequence[Figures]) -> str:
    """One case's line: medians over the seeds, and the worst of each figure in brackets."""
    column = {key: np.array([getattr(one, key) for one in found]) for key in asdict(found[0])}
    ratio = np.maximum(
        column["rotation_deg"] / column["oracle_deg"],
        column["position"] / column["oracle_position"],
    )
    cells = [f"{np.median(column[key]):.4f}" for key in list(column)[:4]]
    cells.append(f"{np.median(ratio):.2f} ({ratio.max():.2f})")
    squared, inside = column["squared"], column["inside"]
    cells.append(f"{np.median(squared):.2f} ({squared.min():.2f}-{squared.max():.2f})")
    cells.append(f"{np.median(inside):.0%} ({inside.min():.0%})")
    cells.append(f"{column['ok'].mean():.0%}, {int(column['wrong'].sum())}")
    return f"| {name} | " + " | ".join(cells) + " |"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--seeds", type=int, default=5, help="recordings of each kind")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    unknown = set(options.cases) - set(CASES)
    if unknown:
        parser.error(f"no such case: {sorted(unknown)[0]!r}; allowed: {', '.join(CASES)}")
    titles = ("recording", "deg", "mm", "oracle, deg", "mm", "ratio (worst)", "squared error")
    print("| " + " | ".join((*titles, "inside 95 %", "ok, wrong")) + " |")
    print("| --- " * (len(titles) + 2) + "|")
    stored: dict[str, Any] = {}
    with ProcessPoolExecutor(options.workers) as pool:
        for name in options.cases or CASES:
            seeds = range(options.seeds)
            found = list(pool.map(figures_of, [name] * options.seeds, seeds))
            stored[name] = [asdict(each) for each in found]
            print(line_of(name, found), flush=True)
    if options.json:
        options.json.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

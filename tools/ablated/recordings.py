"""Recordings with truth: those of the repository, simulated ones, and real ones where at hand."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarks.recordings import MARKERS
from benchmarks.search_cases import looking_at
from scipy.spatial.transform import Rotation

from ablated.cases import Case, Floats, Frame, Recording
from mixpose.frames import pair
from mixpose.poses.jsonl import read_poses
from mixpose.runner import begin, observe, open_sources
from mixpose.session import load_session
from mixpose.simulation import SimulationOptions, simulate

EYES = ([0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [-0.8, -0.6, 0.0])
SYNTHETIC = Path(__file__).resolve().parents[2] / "data" / "synthetic"


@dataclass(frozen=True)
class Source:
    """Where a recording is, and how far off a right pose may be.

    Attributes
    ----------
    session, truth : str
        Files in the folder of all recordings.
    largest_angle_deg, largest_shift : float
        The shift in the session's unit.
    frames : int
        At most so many are taken.
    alone : bool
        Whether its frames have nothing to do with each other: then no start is given.
    """

    session: str
    truth: str
    largest_angle_deg: float
    largest_shift: float
    frames: int = 1000
    alone: bool = False


REAL = (
    Source("disk_effector/effector.toml", "truth_effector.jsonl", 1.0, 5.0, alone=True),
    Source("disk_effector/bed.toml", "truth_bed.jsonl", 1.0, 5.0, alone=True),
    Source("led_tee/session.toml", "truth.jsonl", 3.0, 0.02, alone=True),
    Source("stereo_chessboard/session.toml", "truth.jsonl", 1.0, 5.0),
    Source("webcams4_a/session_reference.toml", "truth.jsonl", 3.0, 0.02, frames=12),
    Source("uwb_trolley/session.toml", "truth.jsonl", 20.0, 0.2, frames=40),
)

MADE = (
    Source("two_cameras/session.toml", "truth.jsonl", 1.0, 2.0),
    Source("one_camera_video/session.toml", "truth.jsonl", 1.0, 5.0, frames=30),
    Source("parallel_beams/session.toml", "truth.jsonl", 1.0, 2.0, frames=6),
    Source("range_profiles/session.toml", "truth.jsonl", 2.0, 4.0, frames=6),
    Source("real_room/session.toml", "truth.jsonl", 0.5, 2.0, frames=20),
)

BOARD = [[25.0 * i, 25.0 * j, 0.0] for i in range(6) for j in range(4)]
FLAT = [[-60.0, 0.0, -40.0], [70.0, 0.0, -55.0], [20.0, 0.0, 65.0], [-75.0, 0.0, 30.0],
        [5.0, 0.0, -10.0], [80.0, 0.0, 35.0]]  # fmt: skip


@dataclass(frozen=True)
class Simulated:
    """A body before cameras, and what happens to it."""

    name: str
    points: list[list[float]]
    cameras: int
    distance: float
    options: SimulationOptions
    limits: tuple[float, float] = (1.0, 5.0)
    knocked_deg: float = 0.0  # by which the last camera was turned after its calibration


SIMULATED = (
    Simulated("hidden and clutter", MARKERS, 2, 1000.0,
              SimulationOptions(40, seed=1, hidden=0.3, clutter=6, pixel_noise=0.3)),
    Simulated("fast", MARKERS, 2, 1000.0,
              SimulationOptions(40, seed=2, hidden=0.1, clutter=2, pixel_noise=0.3,
                                amplitude_rotation_deg=60, amplitude_translation=150, period_s=1)),
    Simulated("fast board", BOARD, 2, 1000.0,
              SimulationOptions(40, seed=3, hidden=0.1, clutter=2, pixel_noise=0.3,
                                amplitude_translation=120, period_s=0.6)),
    # one camera's depth errs by some per cent where so few pixels show the tilt
    Simulated("flat, one camera", FLAT, 1, 1500.0,
              SimulationOptions(40, seed=4, hidden=0.05, clutter=1, pixel_noise=0.3), (5.0, 50.0)),
    Simulated("flat and small", FLAT, 1, 6000.0,
              SimulationOptions(20, seed=6, hidden=0.05, clutter=1, pixel_noise=0.3),
              (20.0, 400.0)),
    Simulated("a knocked camera", MARKERS, 3, 1000.0,
              SimulationOptions(20, seed=7, hidden=0.1, clutter=2, pixel_noise=0.3),
              knocked_deg=2.0),
    Simulated("a camera slightly turned", MARKERS, 3, 1000.0,
              SimulationOptions(20, seed=9, hidden=0.1, clutter=2, pixel_noise=0.3),
              knocked_deg=0.1),
    Simulated("spots that touch", MARKERS, 2, 9000.0,
              SimulationOptions(15, seed=5, noise=1.0, spot_sigma=2.0), (3.0, 10.0)),
    Simulated("few among others", MARKERS[:5], 2, 2000.0,
              SimulationOptions(30, seed=10, noise=1.0, spot_sigma=2.0, clutter=25, others=2)),
)  # fmt: skip


DEFORMED = "deformed, grey values"


def synthetic_cases(names: Collection[str] = ()) -> Iterator[Case]:
    """The recordings of the repository: those of some names, or all."""
    for source in MADE:
        if not names or source.session.split("/")[0] in names:
            yield _case(SYNTHETIC, source)


def real_cases(folder: Path, names: Collection[str] = ()) -> Iterator[Case]:
    """Real recordings, of some names or all; those that are not in the folder are left out."""
    for source in REAL:
        is_named = not names or source.session.split("/")[0] in names
        if is_named and (folder / source.session).exists():
            yield _case(folder, source)


def simulated_cases(folder: Path, names: Collection[str] = ()) -> Iterator[Case]:
    """Recordings made now, in a folder that is empty: those of some names, or all."""
    for one in (each for each in SIMULATED if not names or each.name in names):
        plain, made = folder / f"{one.name}.toml", folder / one.name
        plain.write_text(_session_text(one), encoding="utf-8")
        simulate(load_session(plain), made, one.options)
        if one.knocked_deg:
            (made / "session.toml").write_text(_session_text(one, one.knocked_deg))
        source = Source(f"{one.name}/session.toml", "truth.jsonl", *one.limits)
        yield replace(_case(folder, source), name=one.name)
    if not names or DEFORMED in names:
        yield _deformed_case(folder)


def _deformed_case(folder: Path) -> Case:
    """Grey values of a body whose features are elsewhere in each frame."""
    name = DEFORMED
    text = (SYNTHETIC / "parallel_beams" / "session.toml").read_text(encoding="utf-8")
    plain, made = folder / f"{name}.toml", folder / name
    plain.write_text(text.replace("points = [", "sigma = 4.0\npoints = [", 1), encoding="utf-8")
    simulate(load_session(plain), made, SimulationOptions(8, seed=8, deform=True))
    source = Source(f"{name}/session.toml", "truth.jsonl", 5.0, 10.0)
    return replace(_case(folder, source), name=name)


def _session_text(one: Simulated, knocked_deg: float = 0.0) -> str:
    turn = Rotation.from_euler("xyz", [0.2, -0.3, 0.4]).as_rotvec().tolist()
    lines = [
        'unit = "mm"', "[object]", 'name = "body"', f"points = {one.points}",
        "[start]", f"rotation_vector = {turn}", "translation = [0, 0, 0]",
        "rotation_deg = 10", "distance = 20",
    ]  # fmt: skip
    for k, eye in enumerate(EYES[: one.cameras]):
        T = looking_at(one.distance * np.array(eye), np.zeros(3))
        if k == one.cameras - 1:
            T[:3] = Rotation.from_euler("y", knocked_deg, degrees=True).as_matrix() @ T[:3]
        source = f"c{k}_*.png" if one.options.spot_sigma else f"c{k}.csv"
        lines += [
            "[[sensor]]", f'name = "c{k}"', 'model = "pinhole"', f'source = "{source}"',
            "fps = 25.0", "resolution = [640, 512]",
            "camera_matrix = [[900, 0, 319.5], [0, 900, 255.5], [0, 0, 1]]",
            f"T_sensor_world = {T.tolist()}",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _case(folder: Path, source: Source) -> Case:
    path = folder / source.session
    session = load_session(path)
    if source.alone:
        session = replace(session, start=None)
    tracker, _ = begin(session)
    truth = _answers(path.parent / source.truth, session.body.symmetries)
    frames = []
    with closing(pair(open_sources(session, {}))) as sets:
        for one in sets:
            if one.number in truth:
                views = observe(session, one)
                frames.append(Frame(one.number, one.time_s, views, truth[one.number]))
            if len(frames) == source.frames:
                break
    parts = [[frame] for frame in frames] if source.alone else [frames]
    name = (
        f"{path.parent.name} {path.stem}" if path.stem in ("effector", "bed") else path.parent.name
    )
    recordings = [Recording(tracker, part) for part in parts]
    return Case(name, recordings, source.largest_angle_deg, source.largest_shift)


def _answers(path: Path, symmetries: Floats) -> dict[int, Floats]:
    """All right poses of each frame."""
    found: dict[int, list[Floats]] = {}
    for pose in read_poses(path).poses:
        if pose.T_world_object is not None:
            found.setdefault(pose.frame, []).append(pose.T_world_object)
    return {k: (np.stack(v)[:, None] @ symmetries).reshape(-1, 4, 4) for k, v in found.items()}

"""The recordings of `tools/real_errors.py`: a body before cameras, and what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from benchmarks.recordings import MARKERS
from benchmarks.search_cases import looking_at
from scipy.spatial.transform import Rotation

from mixpose.simulation import SimulationOptions
from rigs import changes

Change: TypeAlias = Callable[[Path, int], None]

EYES = ([0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.6, -0.7, 0.6], [-0.5, -0.8, 0.5])
BOARD = [[25.0 * i, 25.0 * j, 0.0] for i in range(6) for j in range(5)]
# nearly flat: what a mirror image of it is hardly told from
TOOL = [[-80, -40, 0], [70, -55, 3], [95, 30, -2], [10, 60, 2], [-60, 45, -3], [20, -10, 4]]
PLATE = [[-80, -60, 0], [85, -50, 0], [60, 70, 0], [-70, 55, 0], [5, -70, 0], [20, 15, 0]]

SPOTS = SimulationOptions(40, noise=1.0, spot_sigma=4.0, period_s=3.0)
TABLE = SimulationOptions(40, pixel_noise=0.05, clutter=2, hidden=0.1)
# half a metre and a hundred degrees per second
FAST = SimulationOptions(
    100, pixel_noise=0.02, amplitude_translation=150.0, amplitude_rotation_deg=30.0, period_s=2.5
)
EVERYTHING = replace(SPOTS, noise=2.0, lamps=2, others=1, occluder=1, jpeg=80, exposure=0.004)


@dataclass(frozen=True)
class Case:
    """A body before cameras, and what is wrong.

    Attributes
    ----------
    options : SimulationOptions
    cameras : int
    distance : float
    points : tuple
    body : tuple of str
        More lines of ``[object]``.
    told : callable
        From the number of a camera to more lines of its ``[[sensor]]``.
    source : str
        What the name of a camera's source ends in.
    change : callable or None
        What is done to a finished recording.
    against : str or None
        The case whose errors those of this one are held against; None: those of robust least
        squares.
    turn : tuple of float
        The body's orientation, rad.
    """

    options: SimulationOptions
    cameras: int = 2
    distance: float = 1000.0
    points: tuple[tuple[float, ...], ...] = tuple(map(tuple, MARKERS))
    body: tuple[str, ...] = ()
    told: Callable[[int], list[str]] = lambda k: ["fps = 25.0"]
    source: str = "_*.png"
    change: Change | None = None
    against: str | None = None
    turn: tuple[float, float, float] = (0.2, -0.3, 0.4)

    def session(self) -> str:
        """The text of the session."""
        turn = Rotation.from_euler("xyz", self.turn).as_rotvec().tolist()
        lines = [
            'unit = "mm"', "[object]", 'name = "body"',
            f"points = {[list(p) for p in self.points]}", *self.body,
            "[start]", f"rotation_vector = {turn}", "translation = [0, 0, 0]",
            "rotation_deg = 10", "distance = 20",
        ]  # fmt: skip
        for k, eye in enumerate(EYES[: self.cameras]):
            T = looking_at(self.distance * np.array(eye) / np.linalg.norm(eye), np.zeros(3))
            lines += [
                "[[sensor]]", f'name = "c{k}"', 'model = "pinhole"',
                f'source = "c{k}{self.source}"', "resolution = [640, 512]",
                "camera_matrix = [[900.0, 0, 319.5], [0, 900.0, 255.5], [0, 0, 1]]",
                "distortion = [0.0, 0.0, 0.0, 0.0]", f"T_sensor_world = {T.tolist()}",
                *self.told(k),
            ]  # fmt: skip
        return "\n".join(lines) + "\n"


def _tuples(points: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, points))


def _late(line: str) -> Callable[[int], list[str]]:
    return lambda k: ["fps = 25.0", *([line] if k == 1 else [])]


def _told(*lines: str) -> Callable[[int], list[str]]:
    return lambda k: ["fps = 25.0", *lines]


def _disks(count: int, radius: float) -> tuple[str, ...]:
    return 'shape = "disk"', f"radius = {radius}", f"normals = {[[0, 0, 1]] * count}"


def _web_cam(k: int) -> list[str]:
    """A web cam reads row after row, which is told, and is late, which nobody knows."""
    return ["fps = 25.0", "readout = 0.02", *(['delay = "estimate"'] if k else [])]


_TABLES = Case(TABLE, source=".csv")
_MOVING = Case(FAST, source=".csv")
_BALLS = ('shape = "sphere"', "radius = 6.0")
# as large as what `changes.bad_lens` does
_LENS = "calibration_error = { focal = 0.0003, principal_point = 0.35 }"

CASES = {
    # what independent noise makes
    "ideal": Case(replace(SPOTS, spot_sigma=1.6)),
    "one camera": Case(replace(SPOTS, spot_sigma=1.6), cameras=1),
    # cut and merged
    "large spots that merge": Case(replace(SPOTS, spot_sigma=6.0, amplitude_rotation_deg=60)),
    "far spots that merge": Case(replace(SPOTS, spot_sigma=2.0), distance=5000.0),
    "cut by the edge": Case(replace(SPOTS, amplitude_translation=230.0, period_s=2.0)),
    "arm in front": Case(SPOTS, change=changes.arm),
    "spheres that merge, an arm": Case(
        replace(SPOTS, occluder=1, amplitude_rotation_deg=60),
        body=('shape = "sphere"', "radius = 14.0"),
    ),
    # in time
    "moving": _MOVING,
    "late, told": replace(_MOVING, told=_late("delay = 0.006"), against="moving"),
    "late, estimated": replace(
        _MOVING,
        options=replace(FAST, delay={"c1": 0.006}),
        told=_late('delay = "estimate"'),
        against="moving",
    ),
    "late, not told": replace(
        _MOVING, options=replace(FAST, delay={"c1": 0.006}), against="moving"
    ),
    "out of step, times": replace(
        _MOVING, options=replace(FAST, out_of_step=0.008), told=lambda k: [], against="moving"
    ),
    "rolling, told": replace(_MOVING, told=_told("readout = 0.02"), against="moving"),
    "rolling, not told": replace(
        _MOVING, options=replace(FAST, readout=0.02), against="moving"
    ),
    # markers with a size
    "dots on a board, one colour camera, JPEG": Case(
        replace(SPOTS, bayer=True, jpeg=85),
        cameras=1,
        distance=600.0,
        points=_tuples(BOARD),
        body=_disks(len(BOARD), 7.0),
        turn=(1.2, 0.3, 0.2),
    ),
    "stickers on a plate, tilted": Case(
        replace(SPOTS, amplitude_rotation_deg=45),
        points=_tuples(PLATE),
        body=_disks(len(PLATE), 8.0),
        turn=(1.57, 0.0, 0.8),
    ),
    "large spheres, clipped": Case(
        replace(SPOTS, brightness=400.0, amplitude_rotation_deg=10),
        body=('shape = "sphere"', "radius = 22.0"),
    ),
    # what lasts
    "turned camera": replace(_TABLES, change=changes.turned),
    "bad lens": replace(_TABLES, change=changes.bad_lens),
    "bad lens, one camera": replace(
        _TABLES, cameras=1, points=_tuples(BOARD), change=changes.bad_lens
    ),
    "bad lens, board": replace(_TABLES, points=_tuples(BOARD), change=changes.bad_lens),
    "turned camera, stated": replace(
        _TABLES,
        change=changes.turned,
        told=_told("calibration_error = { rotation_deg = 0.06 }"),
    ),
    "bad lens, stated": replace(_TABLES, change=changes.bad_lens, told=_told(_LENS)),
    "bad lens, one camera, stated": replace(
        _TABLES,
        cameras=1,
        points=_tuples(BOARD),
        change=changes.bad_lens,
        told=_told(_LENS),
    ),
    "bad lens, board, stated": replace(
        _TABLES, points=_tuples(BOARD), change=changes.bad_lens, told=_told(_LENS)
    ),
    "bad body": replace(_TABLES, change=changes.bad_body),
    # everything at once
    "two web cams, everything": Case(
        replace(EVERYTHING, bayer=True, delay={"c1": 0.004}), body=_BALLS, told=_web_cam
    ),
    "four cameras, everything, out of view at times": Case(
        replace(EVERYTHING, mirror=0.3, amplitude_translation=300.0, period_s=2.0),
        cameras=4,
        body=_BALLS,
    ),
    "others stay, the body is carried away": Case(
        replace(SPOTS, others=2, away_from=25), cameras=4, body=_BALLS
    ),
    "flat tool over a polished table, covered": Case(
        replace(SPOTS, mirror=0.45), points=_tuples(TOOL), body=_BALLS, change=changes.covered
    ),
}  # fmt: skip

"""Write docs/figures/two_cameras.png: a frame, its density, its pose, and the trajectory.

python tools/make_pictures.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray
from paper.figures import new_figure

import mixpose
from mixpose.pictures import Part, displayable, draw_pose
from mixpose.poses.jsonl import read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.records import FrameSet, PointPattern
from mixpose.rigid import transform

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

Floats: TypeAlias = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
RECORDING = ROOT / "data" / "synthetic" / "two_cameras"
FRAME = 38  # with a false spot and a hidden marker in the left image
SENSOR = "left"
CORNER, SIDE = (213, 148), 240  # of the image, around the body
ZOOM = 2
SHOWN_SIGMA = 7.0  # px; the finest blur would be dots


def main(arguments: list[str]) -> int:
    folder = Path(arguments[0]) if arguments else ROOT / "docs" / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    session = mixpose.load_session(RECORDING / "session.toml")
    estimates: list[mixpose.Estimate] = []
    seen: dict[int, tuple[NDArray[np.uint8], mixpose.View]] = {}

    def watch(
        frame_set: FrameSet, views: Sequence[mixpose.View], estimate: mixpose.Estimate
    ) -> None:
        if estimate.frame == FRAME:
            image = np.asarray(frame_set.frames[SENSOR].data, dtype=np.uint8)
            seen[FRAME] = image, next(view for view in views if view.name == SENSOR)

    estimates.extend(mixpose.run(session, watch=watch))
    image, view = seen[FRAME]
    figure = new_figure(11, 3.3)
    axes = figure.subplots(1, 4)
    show_frame(axes[0], image)
    show_density(axes[1], view)
    show_pose(axes[2], image, view, session.body, estimates[FRAME])
    show_trajectory(axes[3], estimates)
    path = folder / "two_cameras.png"
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})
    print(path.name, path.stat().st_size // 1000, "kB")
    return 0


def show_frame(axes: Axes, image: NDArray[np.uint8]) -> None:
    axes.imshow(cut_out(displayable(image)), cmap="gray")
    axes.set_title(f"frame {FRAME}, left camera", fontsize=9)
    axes.axis("off")


def show_density(axes: Axes, view: mixpose.View) -> None:
    u, v = np.meshgrid(CORNER[0] + np.arange(SIDE), CORNER[1] + np.arange(SIDE))
    pixels = np.stack([u, v], axis=-1).astype(np.float64)
    box = pixels[0, 0], pixels[-1, -1]
    values = view.observation.density(SHOWN_SIGMA, box).sample(pixels)
    axes.imshow(np.sqrt(np.maximum(values, 0)), cmap="inferno")
    axes.set_title("density of where features are", fontsize=9)
    axes.axis("off")


def show_pose(
    axes: Axes,
    image: NDArray[np.uint8],
    view: mixpose.View,
    body: mixpose.Body,
    estimate: mixpose.Estimate,
) -> None:
    cut = cut_out(displayable(image)).repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
    part = Part(ZOOM, (float(CORNER[0]), float(CORNER[1])))
    T = estimate.T_world_object
    drawn = draw_pose(cut, view.sensor, body, T, part=part)
    axes.imshow(drawn[..., ::-1])
    assert T is not None
    predicted, _ = view.sensor.project(transform(T, body.means))
    pattern = view.observation.pattern
    assert isinstance(pattern, PointPattern)
    apart = np.linalg.norm(predicted[:, None] - pattern.points, axis=-1)
    for where, text in (
        (predicted[apart.min(axis=1) > SHOWN_SIGMA], "hidden"),
        (pattern.points[apart.min(axis=0) > SHOWN_SIGMA], "false"),
    ):
        for u, v in part.places(where):
            axes.text(u, v - 20, text, color="white", fontsize=9, ha="center")
    axes.set_title(f"pose from both cameras: {estimate.status}", fontsize=9)
    axes.axis("off")


def show_trajectory(axes: Axes, estimates: list[mixpose.Estimate]) -> None:
    truth = places(read_poses(RECORDING / "truth.jsonl").poses)
    found = places(estimates)
    for k, name in enumerate("xyz"):
        axes.plot(truth[:, 0], truth[:, 1 + k], color=f"C{k}", linewidth=1)
        axes.plot(found[:, 0], found[:, 1 + k], ".", color=f"C{k}", markersize=5, label=name)
    axes.set_title("positions, mm, on the true path", fontsize=9)
    axes.set_xlabel("frame", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8, ncols=3, loc="upper right", frameon=False)
    axes.margins(y=0.15)
    axes.set_box_aspect(1)


def places(poses: Sequence[mixpose.Estimate] | Sequence[PoseLine]) -> Floats:
    """Number and position (n, 4) of the frames that have a pose."""
    return np.array([(p.frame, *T[:3, 3]) for p in poses if (T := p.T_world_object) is not None])


def cut_out(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    u, v = CORNER
    return picture[v : v + SIDE, u : u + SIDE]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

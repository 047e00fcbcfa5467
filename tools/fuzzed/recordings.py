"""Whole recordings, one file of which is mutated: a kind for each kind of file."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

SESSION = """unit = "mm"
[object]
name = "body"
{body}
[start]
rotation_vector = [0, 0, 0]
translation = [0, 0, 900]
[[sensor]]
name = "c"
{sensor}
"""
BODY = [[0, 0, 0], [100, 0, 0], [0, 120, 0], [-80, -60, 90], [60, 70, 20]]
POINTS = f"points = {BODY}"
PLACES = ((160.0, 120.0), (193.5, 120.0), (160.0, 160.1), (135.6, 101.7), (179.6, 142.9))
CAMERA = """model = "pinhole"
source = "{source}"
resolution = [320, 240]
camera_matrix = [[300, 0, 160], [0, 300, 120], [0, 0, 1]]
distortion = [0.1, 0.01, 0, 0]"""


@dataclass(frozen=True)
class Kind:
    """A whole recording, the file in it that is mutated, and what is run on it."""

    make: Callable[[Path], None]
    file: str
    arguments: tuple[str, ...] = ("run", "session.toml", "--stop", "2", "-o", "poses.jsonl")


def spots(seed: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    picture = np.full((240, 320), 12, np.uint8)
    noise = np.random.default_rng(seed).integers(0, 4, picture.shape)
    for u, v in PLACES:
        cv2.circle(picture, (round(u) + seed, round(v)), 2, 200, -1)
    return (picture + noise).astype(np.uint8)


def session(folder: Path, sensor: str, body: str = POINTS) -> None:
    text = SESSION.format(body=body, sensor=sensor)
    (folder / "session.toml").write_text(text, encoding="utf-8")


def detections(folder: Path) -> None:
    rows = [f"{k},{u + k},{v},1" for k in range(3) for u, v in PLACES]
    (folder / "t.csv").write_text("frame,u,v,weight\n" + "\n".join(rows) + "\n", encoding="utf-8")


def with_table(folder: Path) -> None:
    detections(folder)
    session(folder, CAMERA.format(source="t.csv"))


def with_times(folder: Path) -> None:
    detections(folder)
    (folder / "times.csv").write_text("frame,time_s\n0,0.1\n1,0.2\n2,0.3\n", encoding="utf-8")
    session(folder, CAMERA.format(source="t.csv") + '\ntimes = "times.csv"')


def with_markers(name: str, content: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        detections(folder)
        (folder / name).write_text(content, encoding="utf-8")
        session(folder, CAMERA.format(source="t.csv"), f'file = "{name}"')

    return make


def with_vicon(folder: Path) -> None:
    parameters, targets = "", ""
    for k, point in enumerate(BODY):
        for axis, value in zip("xyz", point, strict=True):
            parameters += f'<Parameter NAME="m{k}_{axis}" VALUE="{value}"/>\n'
        words = " ".join(f"'m{k}_{axis}'" for axis in "xyz")
        targets += (
            f'<TargetLocalPointToWorldPoint MARKER="m{k}" POSITION="{words}" SEGMENT="body"/>\n'
        )
    with_markers(
        "m.vsk",
        f"<KinematicModel><Parameters>{parameters}</Parameters><TargetSet><Targets>{targets}"
        "</Targets></TargetSet></KinematicModel>",
    )(folder)


def with_ndi(folder: Path) -> None:
    with_markers("m.rom", "")(folder)
    content = bytearray(752)
    content[:4] = b"NDI\0"
    numbers = [float(value) for point in BODY for value in point]
    struct.pack_into("<I", content, 28, len(BODY))
    struct.pack_into(f"<{len(numbers)}f", content, 72, *numbers)
    struct.pack_into("<H", content, 4, sum(content[6:]) & 0xFFFF)
    (folder / "m.rom").write_bytes(content)


def with_calibration(name: str, content: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        detections(folder)
        (folder / name).write_text(content, encoding="utf-8")
        text = f'model = "pinhole"\nsource = "t.csv"\ncalibration = "{name}"'
        session(folder, text)

    return make


def with_images(suffix: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        for k in range(2):
            cv2.imwrite(str(folder / f"i{k}{suffix}"), spots(k))
        session(folder, CAMERA.format(source=f"i*{suffix}"))

    return make


def with_video(name: str, codec: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        code = cv2.VideoWriter.fourcc(*codec)
        video = cv2.VideoWriter(str(folder / name), code, 25.0, (320, 240))
        for k in range(4):
            video.write(cv2.cvtColor(spots(k), cv2.COLOR_GRAY2BGR))
        video.release()
        session(folder, CAMERA.format(source=name))

    return make


def with_profiles(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        bins = np.arange(300.0)[None, :, None]
        lengths = np.linalg.norm(np.add(BODY, [0, 0, 900]), axis=1) - 800
        values = np.exp(-((bins - lengths - 2 * np.arange(3)[:, None, None]) ** 2) / 8).sum(axis=2)
        if name.endswith(".npy"):
            np.save(folder / name, values.astype(np.float32))
        else:
            np.savetxt(folder / name, values, delimiter=",", fmt="%.4f")
        sensor = f'model = "lateration"\nsource = "{name}"\nposition = [0, 0, 0]\nrange_min = 800\n'
        sensor += "bin_size = 1.0\n[sensor.extract]\nsigma = 3.0"
        # one range tells one direction; all six would make each input take seconds
        session(folder, sensor + '\n[estimator]\nfree = ["z"]')

    return make


def with_poses(folder: Path) -> None:
    line = (
        '{"type": "pose", "frame": %d, "time_s": 0.1, "object": "body", "status": "ok", '
        '"T_world_object": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]], "score": 0.5, '
        '"sensors": {"c": {"used": true, "explained": 0.5, "rms": 0.1}}, "hypotheses": []}\n'
    )
    header = '{"type": "header", "format": "mixpose-poses", "version": 1, "unit": "mm"}\n'
    text = header + "".join(line % k for k in range(3))
    (folder / "poses.jsonl").write_text(text, encoding="utf-8")


OPENCV = """%YAML:1.0
---
image_width: 320
image_height: 240
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 300., 0., 160., 0., 300., 120., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0.01, 0., 0., 0. ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.01, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [300.0, 300.0, 160.0, 120.0]
  resolution: [320, 240]
"""
ROS = """image_width: 320
image_height: 240
camera_matrix:
  rows: 3
  cols: 3
  data: [300, 0, 160, 0, 300, 120, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, 0.01, 0, 0, 0]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>300. 0. 160. 0. 300. 120. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>4</cols><dt>d</dt>
<data>0.1 0.01 0. 0.</data></distortion_coefficients>
</opencv_storage>
"""
TABLES = """[cam_0]
name = "c"
size = [320, 240]
matrix = [[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.01, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 0.0]
"""
MARKERS = (
    "name,x,y,z,sigma\na,0,0,0,.1\nb,100,0,0,.1\nc,0,120,0,.1\nd,-80,-60,90,.1\ne,60,70,20,0\n"
)

KINDS: dict[str, Kind] = {
    "session": Kind(with_table, "session.toml"),
    "check": Kind(with_table, "session.toml", ("check", "session.toml", "--quick")),
    "simulate": Kind(
        with_table, "session.toml", ("simulate", "session.toml", "-o", "out", "--frames", "1")
    ),
    "table": Kind(with_table, "t.csv"),
    "times": Kind(with_times, "times.csv"),
    "markers": Kind(with_markers("m.csv", MARKERS), "m.csv"),
    "vicon": Kind(with_vicon, "m.vsk"),
    "ndi": Kind(with_ndi, "m.rom"),
    "xml": Kind(with_calibration("c.xml", OPENCV_XML), "c.xml"),
    "import": Kind(
        with_calibration("c.toml", TABLES), "c.toml", ("import", "c.toml", "-o", "s.toml")
    ),
    "opencv": Kind(with_calibration("c.yml", OPENCV), "c.yml"),
    "kalibr": Kind(with_calibration("c.yaml", KALIBR), "c.yaml"),
    "ros": Kind(with_calibration("c.yaml", ROS), "c.yaml"),
    "png": Kind(with_images(".png"), "i0.png"),
    "jpg": Kind(with_images(".jpg"), "i0.jpg"),
    "bmp": Kind(with_images(".bmp"), "i0.bmp"),
    "tif": Kind(with_images(".tif"), "i0.tif"),
    "avi": Kind(with_video("v.avi", "MJPG"), "v.avi"),
    "mp4": Kind(with_video("v.mp4", "mp4v"), "v.mp4"),
    "mkv": Kind(with_video("v.mkv", "mp4v"), "v.mkv"),
    "npy": Kind(with_profiles("p.npy"), "p.npy"),
    "profile": Kind(with_profiles("p.csv"), "p.csv"),
    "poses": Kind(with_poses, "poses.jsonl", ("convert", "poses.jsonl", "-o", "poses.csv")),
    "truth": Kind(with_poses, "poses.jsonl", ("evaluate", "poses.jsonl", "poses.jsonl")),
}

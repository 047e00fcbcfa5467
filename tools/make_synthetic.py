"""Write data/synthetic/ anew: small recordings with known poses, the same bytes every time.

python tools/make_synthetic.py [FOLDER]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mixpose.session import load_session
from mixpose.simulation import SimulationOptions, simulate

FOLDER = Path(__file__).resolve().parents[1] / "data" / "synthetic"

TWO_CAMERAS = """\
# Two cameras at about right angles see seven markers on a body that moves and turns.
# Each view has a false spot in every second frame, and a marker is hidden now and then.
unit = "mm"

[object]
name = "tracker"
points = [
    [0.0, 0.0, 0.0],
    [95.0, 12.0, -8.0],
    [-62.0, 70.0, 14.0],
    [-38.0, -84.0, 22.0],
    [41.0, 48.0, 76.0],
    [58.0, -57.0, 45.0],
    [-74.0, -10.0, -58.0],
]

# Near the first pose, but not on it: about 3 degrees and 3 mm away.
[start]
rotation_vector = [0.4, -0.3, 0.9]
translation = [12.0, -8.0, 5.0]

[extract]
method = "blobs"
sigma = 1.5

[[sensor]]
name = "left"
model = "pinhole"
source = "left*.png"
fps = 25
resolution = [640, 512]
camera_matrix = [[812.4, 0.0, 322.7], [0.0, 811.9, 251.3], [0.0, 0.0, 1.0]]
distortion = [-0.12, 0.05, 0.0004, -0.0003, 0.0]
rotation_vector = [0.06, -0.72, 0.02]
translation = [14.0, -9.0, 780.0]

[[sensor]]
name = "right"
model = "pinhole"
source = "right*.png"
fps = 25
resolution = [640, 512]
camera_matrix = [[807.2, 0.0, 315.9], [0.0, 807.8, 260.4], [0.0, 0.0, 1.0]]
distortion = [-0.11, 0.04, -0.0002, 0.0005, 0.0]
rotation_vector = [-0.04, 0.81, -0.03]
translation = [-11.0, 6.0, 820.0]
"""

ONE_CAMERA_VIDEO = """\
# One camera and a video: six markers, so that each frame has one pose that explains it.
unit = "mm"

[object]
name = "wand"
points = [
    [0.0, 0.0, 0.0],
    [80.0, 6.0, 10.0],
    [-55.0, 48.0, -12.0],
    [-30.0, -66.0, 25.0],
    [36.0, 40.0, 62.0],
    [22.0, -35.0, -48.0],
]

# Near the first pose: about 2.5 degrees and 3 mm away.
[start]
rotation_vector = [-0.5, 0.7, 0.4]
translation = [-15.0, 10.0, 460.0]

[extract]
method = "blobs"
sigma = 1.5

[[sensor]]
name = "camera"
model = "pinhole"
source = "camera.avi"
resolution = [640, 480]
camera_matrix = [[705.3, 0.0, 318.2], [0.0, 704.8, 243.9], [0.0, 0.0, 1.0]]
distortion = [-0.15, 0.06, 0.0, 0.0]
"""

SEVERAL_BODIES = """\
# Two cameras see four bodies that move and hide each other: a tool, a reference, and two rods that
# are identical.  None has a start.
unit = "mm"

[[object]]
name = "tool"
points = [
    [0.0, 0.0, 0.0],
    [52.0, 6.0, 10.0],
    [-35.0, 38.0, -12.0],
    [-30.0, -46.0, 15.0],
    [36.0, 30.0, 42.0],
    [22.0, -35.0, -38.0],
]

[[object]]
name = "reference"
points = [
    [0.0, 0.0, 0.0],
    [60.0, 0.0, 5.0],
    [0.0, 48.0, -8.0],
    [-44.0, -14.0, 30.0],
    [18.0, -40.0, 44.0],
]

[[object]]
name = "rod"
count = 2
points = [
    [-60.0, 0.0, 0.0],
    [-28.0, 20.0, 6.0],
    [4.0, -18.0, 14.0],
    [31.0, 9.0, -21.0],
    [62.0, -7.0, 10.0],
]

[extract]
method = "blobs"
sigma = 1.5

[[sensor]]
name = "left"
model = "pinhole"
source = "left*.png"
fps = 25
resolution = [640, 512]
camera_matrix = [[812.4, 0.0, 322.7], [0.0, 811.9, 251.3], [0.0, 0.0, 1.0]]
rotation_vector = [0.06, -0.72, 0.02]
translation = [14.0, -9.0, 900.0]

[[sensor]]
name = "right"
model = "pinhole"
source = "right*.png"
fps = 25
resolution = [640, 512]
camera_matrix = [[807.2, 0.0, 315.9], [0.0, 807.8, 260.4], [0.0, 0.0, 1.0]]
rotation_vector = [-0.04, 0.81, -0.03]
translation = [-11.0, 6.0, 930.0]
"""

PAPER_OBJECT = """\
[object]
name = "six-points"
points = [
    [0.0, -25.0, -43.3],
    [100.0, -25.0, -43.3],
    [0.0, 61.6, -93.3],
    [100.0, 111.6, -6.7],
    [100.0, 25.0, 43.3],
    [0.0, 111.6, -6.7],
]

# The paper's pose R (z + w) with a turn of -60 degrees about the third axis and w = (40, 40, 40),
# which makes the translation R w.  The first frame is about 2.5 degrees and 4 mm away.
[start]
rotation_vector = [0.0, 0.0, -1.0471975511965976]
translation = [54.6410161514, -14.6410161514, 40.0]
"""

PARALLEL_BEAMS = f"""\
# Two parallel-beam cameras at right angles, one length unit per px: systems 1 and 2 of Hoegele
# (2024).  The object is six corners of a cube: turned by a third about the cube's diagonal, or
# by a half about an axis across it, it looks the same, so that six poses explain each frame.
unit = "mm"

{PAPER_OBJECT}
# The grey values themselves are the pattern.  Features are as wide in them as the paper's
# sigma_epsilon = 5, which is what spot_sigma says; sigma is the little that is added to that.
[extract]
method = "intensity"
spot_sigma = 5.0
sigma = 1.5

# x_s = cos(angle) x + sin(angle) y, y_s = z
[[sensor]]
name = "angle0"
model = "parallel"
source = "angle0_*.png"
fps = 25
resolution = [400, 320]
pixel_size = 1.0
principal_point = [150.0, 160.0]
T_sensor_world = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]

[[sensor]]
name = "angle90"
model = "parallel"
source = "angle90_*.png"
fps = 25
resolution = [400, 320]
pixel_size = 1.0
principal_point = [150.0, 160.0]
T_sensor_world = [[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
"""

RANGE_PROFILES = f"""\
# Three range sensors, each with a profile of echo over range per frame: system 3 of Hoegele
# (2024).  The object is six corners of a cube, which look the same in six poses.
unit = "mm"

{PAPER_OBJECT}
# Echoes are as wide in the profiles as the paper's sigma_epsilon = 5, which is what spot_sigma
# says; sigma is the little that is added to that.
[extract]
spot_sigma = 5.0
sigma = 1.5

[[sensor]]
name = "front"
model = "lateration"
source = "front.npy"
fps = 25
position = [0.0, -1000.0, 0.0]
range_min = 700.0
bin_size = 1.0

[[sensor]]
name = "side"
model = "lateration"
source = "side.npy"
fps = 25
position = [1000.0, 0.0, 0.0]
range_min = 700.0
bin_size = 1.0

[[sensor]]
name = "top"
model = "lateration"
source = "top.npy"
fps = 25
position = [0.0, 0.0, 1000.0]
range_min = 700.0
bin_size = 1.0
"""


CAMERA_AND_RANGES = """\
# A camera and two range sensors together.  The camera tells directions well and distances badly,
# the range sensors the other way round, so that each has what the other lacks.
unit = "mm"

[object]
name = "frame"
points = [
    [0.0, 0.0, 0.0],
    [95.0, 12.0, -8.0],
    [-62.0, 70.0, 14.0],
    [-38.0, -84.0, 22.0],
    [41.0, 48.0, 76.0],
    [58.0, -57.0, -45.0],
]

# Near the first pose: about 2.5 degrees and 4 mm away.
[start]
rotation_vector = [0.5, -0.4, 0.8]
translation = [20.0, -10.0, 1500.0]

[[sensor]]
name = "camera"
model = "pinhole"
source = "camera.avi"
fps = 25
resolution = [480, 400]
camera_matrix = [[905.3, 0.0, 238.2], [0.0, 904.8, 203.9], [0.0, 0.0, 1.0]]
distortion = [-0.1, 0.03, 0.0, 0.0]

[sensor.extract]
method = "blobs"
sigma = 1.5

# Beside the camera: along its line of sight, where it is weakest.
[[sensor]]
name = "near"
model = "lateration"
source = "near.npy"
fps = 25
position = [150.0, 0.0, 0.0]
range_min = 1300.0
bin_size = 1.0

[sensor.extract]
spot_sigma = 4.0
sigma = 1.5

[[sensor]]
name = "aside"
model = "lateration"
source = "aside.npy"
fps = 25
position = [-900.0, 300.0, 700.0]
range_min = 950.0
bin_size = 1.0

[sensor.extract]
spot_sigma = 4.0
sigma = 1.5
"""

REAL_ROOM = """\
# What real rigs do, told in this file: spheres in place of points, rolling shutters, a camera that
# is late.  What it does not tell: a lamp, another body, a polished table, an arm in front, JPEG.
unit = "mm"

[object]
name = "spheres"
shape = "sphere"
radius = 6.0
points = [
    [0.0, 0.0, 0.0],
    [95.0, 12.0, -8.0],
    [-62.0, 70.0, 14.0],
    [-38.0, -84.0, 22.0],
    [41.0, 48.0, 76.0],
    [58.0, -57.0, 45.0],
    [-74.0, -10.0, -58.0],
]

[extract]
method = "blobs"
sigma = 1.5

[[sensor]]
name = "left"
model = "pinhole"
source = "left*.jpg"
fps = 30
resolution = [400, 320]
camera_matrix = [[508.4, 0.0, 201.7], [0.0, 507.9, 157.3], [0.0, 0.0, 1.0]]
distortion = [-0.12, 0.05, 0.0004, -0.0003, 0.0]
readout = 0.02
exposure = 0.004
rotation_vector = [0.06, -0.72, 0.02]
translation = [14.0, -9.0, 780.0]

[[sensor]]
name = "right"
model = "pinhole"
source = "right*.jpg"
fps = 30
resolution = [400, 320]
camera_matrix = [[507.2, 0.0, 197.9], [0.0, 507.8, 162.4], [0.0, 0.0, 1.0]]
distortion = [-0.11, 0.04, -0.0002, 0.0005, 0.0]
readout = 0.02
exposure = 0.004
delay = 0.005
rotation_vector = [-0.04, 0.81, -0.03]
translation = [-11.0, 6.0, 820.0]
"""


@dataclass(frozen=True)
class Recording:
    """A session and how it is simulated."""

    session: str
    options: SimulationOptions


RECORDINGS = {
    "real_room": Recording(
        REAL_ROOM,
        SimulationOptions(
            frames=20,
            seed=16,
            background=-2.0,
            noise=1.0,
            lamps=1,
            others=1,
            mirror=0.4,
            occluder=1,
            jpeg=75,
            amplitude_translation=25.0,
            amplitude_rotation_deg=22.0,
            period_s=2.0,
        ),
    ),
    "camera_and_ranges": Recording(
        CAMERA_AND_RANGES,
        SimulationOptions(
            frames=30,
            seed=15,
            background=-1.0,
            noise=1.0,
            brightness_spread=0.05,
            range_snr=100.0,
            amplitude_translation=25.0,
            amplitude_rotation_deg=20.0,
            period_s=2.5,
        ),
    ),
    "two_cameras": Recording(
        TWO_CAMERAS,
        SimulationOptions(
            frames=40,
            seed=11,
            background=-0.5,  # at black most noise is clipped, which keeps the files small
            noise=1.0,
            clutter=0.5,
            hidden=0.02,
            amplitude_translation=30.0,
            amplitude_rotation_deg=25.0,
            period_s=3.0,
        ),
    ),
    "several_bodies": Recording(
        SEVERAL_BODIES,
        SimulationOptions(
            frames=30,
            seed=15,
            background=-2.5,  # nearly all noise is clipped
            noise=1.0,
            amplitude_translation=30.0,
            amplitude_rotation_deg=18.0,
            period_s=3.3,
        ),
    ),
    "one_camera_video": Recording(
        ONE_CAMERA_VIDEO,
        SimulationOptions(
            frames=60,
            seed=12,
            background=-1.0,
            noise=1.0,
            amplitude_translation=30.0,
            amplitude_rotation_deg=20.0,
            period_s=3.0,
        ),
    ),
    "parallel_beams": Recording(
        PARALLEL_BEAMS,
        SimulationOptions(
            frames=20,
            seed=13,
            background=-1.0,
            noise=1.0,
            brightness=110.0,  # two spots on top of each other do not saturate
            amplitude_translation=25.0,
            amplitude_rotation_deg=20.0,
            period_s=2.5,
        ),
    ),
    "range_profiles": Recording(
        RANGE_PROFILES,
        SimulationOptions(
            frames=20,
            seed=14,
            brightness_spread=0.05,
            range_snr=100.0,
            amplitude_translation=25.0,
            amplitude_rotation_deg=20.0,
            period_s=2.5,
        ),
    ),
}


def make_recordings(folder: Path) -> None:
    """Write every recording into a folder of its own, in place of what is there."""
    for name, recording in RECORDINGS.items():
        with tempfile.TemporaryDirectory() as drafts:
            draft = Path(drafts) / "session.toml"
            draft.write_text(recording.session, encoding="utf-8", newline="\n")
            simulate(load_session(draft), folder / name, recording.options, overwrite=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    make_recordings(parser.parse_args().folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())

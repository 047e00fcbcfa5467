"""TRC: tables of marker trajectories, as OpenSim and Cortex read them.

https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim/pages/53089972
"""

from __future__ import annotations

import re
from typing import TextIO

import numpy as np

from mixpose.poses.header import length_ratio
from mixpose.poses.trajectories import Trajectories

MARK = "by mixpose"
"""In the first line of files that mixpose wrote."""


def write_trc(stream: TextIO, trajectories: Trajectories, called: str) -> None:
    """Write trajectories in mm; the format cannot say which places sensors measured.

    What is not known is NaN: an empty cell would shift the row where readers split at any space.
    The name `called` of the file stands in its first line.
    """
    frames, markers = trajectories.places.shape[:2]
    # columns are told apart by tabs, and by some readers at any white space
    names = [re.sub(r"\s", "_", name) for name in trajectories.names]
    rate, first = repr(trajectories.rate), trajectories.first
    axes = [f"{axis}{k + 1}" for k in range(markers) for axis in "XYZ"]
    keys = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame"
    facts = (rate, rate, frames, markers, "mm", rate, first, frames)
    rows = [
        ("PathFileType", "4", "(X/Y/Z)", f"{called} {MARK}"),
        (*keys.split(), "OrigNumFrames"),
        facts,
        ("Frame#", "Time", *(cell for name in names for cell in (name, "", ""))),
        ("", "", *axes),
        (),
    ]
    for row in rows:
        stream.write("\t".join(map(str, row)) + "\n")
    places = trajectories.places * length_ratio(trajectories.unit, "mm")
    for k, flat in enumerate(places.reshape(frames, -1).tolist()):
        cells = ("NaN" if np.isnan(value) else f"{value:.6f}" for value in flat)
        time = (first + k) / trajectories.rate
        stream.write("\t".join([str(first + k), f"{time:.9g}", *cells]) + "\n")
    stream.flush()

"""Limits of inputs, so that none of them takes all memory or time.

Each limit is checked before memory is allocated.  Together they keep a run of a few sensors below
2 GB.
"""

from __future__ import annotations

# of an image: 67 million, more than usual sensors have; each takes up to 20 bytes
MOST_PIXELS = 2**26
MOST_IMAGE_BYTES = 2**29  # of an image file: eight for each of as many pixels
MOST_FEATURES = 2000  # of a body, with pieces of segments: all pairs are compared
MOST_DETECTIONS = 5000  # of one sensor in one frame: drawing one takes 0.2 MB
# of all features of a body together, if densities are integrated by sampling
MOST_SAMPLES = 4_000_000
MOST_BINS = 1_000_000  # of a range profile
# in a range profile: a sum of a million squares still fits in single precision
LARGEST_VALUE = 1e15
# of a table whose rows are not in the order of frames, as it is read into memory
MOST_UNSORTED_ROWS = 1_000_000
# of a session file, a list of sessions, a calibration, a table of markers or a line of poses
MOST_BYTES = 4_000_000
# of a calibration in YAML: the slow reader takes seconds for as much
MOST_YAML_CHARACTERS = 500_000
# brackets, tags or dashes that open a list in a calibration for OpenCV: its reader recurses into
# nested ones, and some 30,000 crash the process
MOST_OPENED = 10_000
MOST_YAML_NODES = 100_000  # of a YAML file with its aliases expanded

"""What a calibration that was interrupted had found: a line of JSON for each camera's frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mixpose.calibration.alone import Hypotheses

Found = dict[tuple[int, int], Hypotheses]
MARK = '{"mixpose-calibration": '


class Saved(Found):
    """Hypotheses that are written to a file as they are found.

    Parameters
    ----------
    key : str
        Names session, recording and version; what another one left is not taken.
    """

    def __init__(self, path: Path, key: str) -> None:
        super().__init__()
        self._path, self._first = path, f"{MARK}{json.dumps(key)}}}"
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        if lines and lines[0] == self._first:
            for line in lines[1:]:
                self._take(line)
        else:
            lines = []
        self.resumed = len(self)
        self._stream = path.open("w", encoding="utf-8", newline="\n")
        self._stream.write(self._first + "\n")
        for (frame, sensor), one in self.items():
            self._write(frame, sensor, one)

    def _take(self, line: str) -> None:
        try:
            frame, sensor, poses, evidence = json.loads(line)
            one = Hypotheses(
                np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
                np.array(evidence, dtype=np.float64),
            )
            super().__setitem__((int(frame), int(sensor)), one)
        except ValueError:
            return  # the last line was cut off

    def __setitem__(self, key: tuple[int, int], one: Hypotheses) -> None:
        super().__setitem__(key, one)
        self._write(*key, one)

    def _write(self, frame: int, sensor: int, one: Hypotheses) -> None:
        line = [frame, sensor, one.poses.tolist(), one.evidence.tolist()]
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()

    def close(self, *, finished: bool) -> None:
        """Close the file; a finished calibration needs it no more."""
        self._stream.close()
        if finished:
            self._path.unlink(missing_ok=True)

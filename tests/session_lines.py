"""A session in which every line may be exchanged for a wrong one, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from mixpose.errors import SessionError
from mixpose.session import load_session

LINES = {
    "unit": 'unit = "mm"',
    "object": '[object]\nname = "tracker"',
    "points": "points = [[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 30]]",
    "sigma": "sigma = 1",
    "normals": "",
    "start": "[start]\nrotation_vector = [0, 0, 0]\ntranslation = [0, 0, 900]",
    "estimator": "[estimator]",
    "extract": "[extract]",
    "left": '[[sensor]]\nname = "left"\nmodel = "pinhole"\nsource = "l*.png"',
    "matrix": "camera_matrix = [[800, 0, 640], [0, 800, 512], [0, 0, 1]]",
    "left more": "",
    "beam": '[[sensor]]\nname = "beam"\nmodel = "parallel"\nsource = "b*.png"',
    "beam keys": "pixel_size = 0.5\nprincipal_point = [100, 50]",
    "sonar": '[[sensor]]\nname = "sonar"\nmodel = "lateration"\nsource = "s.csv"',
    "sonar keys": "position = [1, 2, 3]",
}


def message_of(folder: Path, text: str | bytes) -> str:
    path = folder / "session.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SessionError) as caught:
        load_session(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{path}: ")


def with_lines(**changed: str) -> str:
    lines = LINES | {key.replace("_", " "): line for key, line in changed.items()}
    return "\n".join(lines.values())

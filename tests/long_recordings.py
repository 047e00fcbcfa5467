"""Recordings longer than a test waits for, so that what happens to a run happens midway."""

from __future__ import annotations

from pathlib import Path

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RANGE_FRAMES = 1500
CAMERA_FRAMES = 600
RANGES = {  # of the six points at [start], to 0.1 mm
    "front": (973.4, 890.1, 1023.3, 976.1, 923.7, 1052.6),
    "side": (967.4, 924.0, 893.7, 800.7, 882.1, 850.4),
    "top": (1004.2, 1013.1, 1058.9, 988.5, 929.6, 979.3),
}


def long_ranges(folder: Path, names: str) -> list[Path]:
    """Sessions of these one-letter names on the ranges of a body that lies still."""
    text = (SYNTHETIC / "range_profiles" / "session.toml").read_text(encoding="utf-8")
    text = "\n".join(
        line
        for line in text.replace(".npy", ".csv").splitlines()
        if not line.startswith(("range_min", "bin_size"))
    )
    for name, ranges in RANGES.items():
        rows = "".join(f"{k},{each}\n" for k in range(RANGE_FRAMES) for each in ranges)
        (folder / f"{name}.csv").write_text("frame,range\n" + rows, encoding="utf-8")
    sessions = [folder / f"{name}.toml" for name in names]
    for session in sessions:
        session.write_text(text, encoding="utf-8")
    return sessions


def long_cameras(folder: Path) -> Path:
    """A session on the images of two cameras, to and fro again and again."""
    source = SYNTHETIC / "two_cameras"
    count = len(list(source.glob("left*.png")))
    for k in range(CAMERA_FRAMES):
        n = k % (2 * count - 2)
        n = min(n, 2 * count - 2 - n)
        for side in ("left", "right"):
            (folder / f"{side}{k:04d}.png").symlink_to(source / f"{side}{n:04d}.png")
    session = folder / "session.toml"
    session.write_text((source / "session.toml").read_text(encoding="utf-8"), encoding="utf-8")
    return session

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
SESSIONS = Path(__file__).resolve().parent / "synthetic"


@dataclass(frozen=True)
class Recording:
    """A session and how it is simulated."""

    session: str
    options: SimulationOptions

    @classmethod
    def of(cls, name: str, options: SimulationOptions) -> Recording:
        """A session of tools/synthetic/, simulated with options."""
        return cls((SESSIONS / f"{name}.toml").read_text(encoding="utf-8"), options)


RECORDINGS = {
    "real_room": Recording.of(
        "real_room",
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
    "camera_and_ranges": Recording.of(
        "camera_and_ranges",
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
    "two_cameras": Recording.of(
        "two_cameras",
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
    "several_bodies": Recording.of(
        "several_bodies",
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
    "one_camera_video": Recording.of(
        "one_camera_video",
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
    "parallel_beams": Recording.of(
        "parallel_beams",
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
    "range_profiles": Recording.of(
        "range_profiles",
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

"""Readers under a fuzzer that is guided by the code it reaches: `atheris`, to be installed for it.

    python tools/guided.py KIND [--seconds 60]

A kind is one of `fuzzed/recordings.py`; its file is what is changed, and read in this process,
without any pose being estimated.  Whatever is no `MixposeError` of one line ends the fuzzer, which
keeps the input.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["mixpose"]):
    from mixpose.errors import MixposeError
    from mixpose.poses.jsonl import read_poses
    from mixpose.runner import open_sources
    from mixpose.session import load_session

from fuzzed.recordings import KINDS

LARGEST = 4096  # bytes of an input
FRAMES = 3  # of a recording that are read


def read(folder: Path, file: str) -> None:
    """Read a session and its recording, or poses."""
    try:
        if file.endswith(".jsonl"):
            read_poses(folder / file)
            return
        for source in open_sources(load_session(folder / "session.toml"), {}).values():
            for frame in source.frames(None, None, 1):
                if frame.number >= FRAMES:
                    break
    except MixposeError as error:
        if len(str(error).splitlines()) != 1:
            raise RuntimeError(f"more than one line: {error}") from error


def main() -> None:
    parser = argparse.ArgumentParser(description="Readers under a guided fuzzer.")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--seconds", type=int, default=60)
    options = parser.parse_args()
    kind = KINDS[options.kind]
    folder = Path(tempfile.mkdtemp())
    kind.make(folder)
    corpus = folder / "corpus"
    corpus.mkdir()
    shutil.copy(folder / kind.file, corpus)
    (folder / "dictionary").write_text(DICTIONARY, encoding="ascii")

    def once(data: bytes) -> None:
        (folder / kind.file).write_bytes(data)
        read(folder, kind.file)

    limits = [f"-max_total_time={options.seconds}", f"-max_len={LARGEST}", "-timeout=10"]
    limits += ["-rss_limit_mb=2048", f"-dict={folder / 'dictionary'}", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={Path.cwd()}/", str(corpus)], once)
    atheris.Fuzz()


DICTIONARY = """"nan"
"inf"
"-1"
"1e400"
"99999999999999999999"
"[["
"{"
"&a"
"*a"
"\\x00"
"""


if __name__ == "__main__":
    main()

"""Recordings that are given to two sensors."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import combinations

from mixpose.frames import files_of
from mixpose.runner import source_spec
from mixpose.session import Session


def shared_source_warnings(session: Session, replaced: Mapping[str, str]) -> list[str]:
    """Pairs of sensors that read the same files, the same camera or the same stream.

    Recordings are `replaced` by sensor name.
    """
    read = {
        setup.name: {
            os.path.realpath(place) if os.path.exists(place) else place  # noqa: PTH110 - or an address
            for place in files_of(source_spec(session, setup, replaced.get(setup.name)))
        }
        for setup in session.sensors
    }
    warnings = []
    for (a, own), (b, others) in combinations(read.items(), 2):
        both = own & others
        if both:
            first = os.path.basename(min(both))  # noqa: PTH119 - of an address too
            files = first if len(both) == 1 else f"{len(both)} files ({first}, ...)"
            warnings.append(
                f"sensors {a!r} and {b!r} read the same recording, {files}: give each its own "
                "source"
            )
    return warnings

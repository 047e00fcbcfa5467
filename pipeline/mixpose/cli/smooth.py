"""``mixpose smooth``: smooth poses by all frames before and after them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mixpose import __version__
from mixpose.cli.app import SmoothRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.cli.output import Output, refuse_suffix, refuse_to_overwrite
from mixpose.cli.request import output_of
from mixpose.errors import RecordingError
from mixpose.poses.estimates import header_of
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.trajectories.motion import ORDERS
from mixpose.trajectories.smoothing import SmoothedBody, smooth_body


def smooth_poses(request: SmoothRequest) -> None:
    """Smooth the poses of a file and write them."""
    path, output, fill_s = request.poses, output_of(request.output), request.fill
    poses = read_poses(path)
    if poses.header.get("smoothed"):
        raise RecordingError(
            f"{path}: was smoothed before, its frames are no longer independent; allowed: poses "
            "as mixpose run writes them"
        )
    if any(line.ahead_s for line in poses.poses):
        raise RecordingError(
            f"{path}: holds poses that were foretold, which say no more than those before them; "
            "allowed: poses as mixpose run -o writes them"
        )
    if poses.unit is None:
        raise RecordingError(
            f"{path}: no header says the unit of its lengths; allowed: poses as mixpose run writes "
            "them"
        )
    if output is not None:
        refuse_to_overwrite(output, [path])
        hint = "smoothed poses are JSON lines, of which mixpose convert makes other formats"
        refuse_suffix(output, (".jsonl", ".json", ".ndjson"), hint)
    bodies = {}
    for label in dict.fromkeys(line.label for line in poses.poses):
        lines = [line for line in poses.poses if line.label == label]
        symmetries = poses.symmetries.get(lines[0].object)
        try:
            bodies[label] = smooth_body(lines, symmetries, fill_s=fill_s, motion=request.motion)
        except RecordingError as error:
            raise RecordingError(f"{path}: {error}") from error
    _write(poses, bodies, output)
    for label, body in bodies.items():
        _report(label, body, poses.unit)
    if output is not None:
        count = sum(body.smoothed for body in bodies.values())
        say(f"{counted(count, 'pose')} smoothed -> {output}")


def _write(poses: PoseFile, bodies: dict[str, SmoothedBody], path: Path | None) -> None:
    header = replace(
        header_of(poses, str(poses.unit), __version__),
        smoothed={label: _model(body) for label, body in bodies.items()},
    )
    estimates = [estimate for body in bodies.values() for estimate in body.estimates]
    with Output(path, "jsonl", header, whole=True) as writer:
        for estimate in sorted(estimates, key=lambda estimate: estimate.frame):  # then by body
            writer.write(estimate)


def _model(body: SmoothedBody) -> dict[str, Any]:
    """Return the model of a body's motion for the header."""
    if body.model is None:
        return {}
    of_lengths, of_turns = np.sqrt(body.model.intensities).tolist()
    return {
        "motion": _name(body),
        "intensity": [of_lengths, of_turns],
        "time": "s" if body.timed else "frame",
        "white": body.model.white,
    }


def _name(body: SmoothedBody) -> str:
    return next(name for name, order in ORDERS.items() if body.model and order == body.model.order)


def _report(label: str, body: SmoothedBody, unit: str) -> None:
    model = body.model
    if model is None:
        warn(f"{label}: too few poses that are ok to tell how it moves; none is smoothed")
        return
    time = "s" if body.timed else "frame"
    lengths, turns = np.sqrt(model.intensities) * [1.0, 180 / np.pi]
    power = f"{time}^{model.order - 0.5:g}"
    say(
        f"{label}: white noise in the {_name(body)}, {lengths:.3g} {unit}/{power} and "
        f"{turns:.3g} deg/{power}"
    )
    if model.white < 1:
        say(
            f"{label}: poses scatter less about a smooth path than their covariances say: "
            f"{100 * (1 - model.white):.0f} % of these is taken for errors that last, and stays"
        )
    if model.white > 1:
        warn(
            f"{label}: poses scatter more than their covariances say, which are taken "
            f"{model.white:.2g} times as large"
        )
    counts = [
        (body.decided, "ambiguous frame", "ok by the track"),
        (body.filled, "frame", "filled in, ambiguous and marked"),
    ]
    for count, noun, result in counts:
        if count:
            say(f"{label}: {counted(count, noun)} {result}")
    if body.refused:
        numbers = ", ".join(map(str, body.refused[:8])) + (", ..." if len(body.refused) > 8 else "")
        warn(f"{label}: ok, but far off the poses around them, now ambiguous: frames {numbers}")

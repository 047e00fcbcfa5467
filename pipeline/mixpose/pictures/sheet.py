"""All pictures of one inspected frame, and the sheet that puts them together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.fit import ScheduleRules, blur_schedule
from mixpose.objective import View
from mixpose.pictures.canvas import WHITE, Picture, words
from mixpose.pictures.finding import Finding
from mixpose.pictures.layout import in_grid, stacked
from mixpose.pictures.overlay import FOUND, STATUS_COLOURS
from mixpose.pictures.plots import objective_picture, ranges_picture
from mixpose.pictures.slices import objective_around
from mixpose.pictures.stages import (
    densities_picture,
    features_picture,
    pose_picture,
    threshold_picture,
)
from mixpose.records import Estimate
from mixpose.session import Session
from mixpose.tracking import TrackedBody

Floats: TypeAlias = NDArray[np.float64]

BODIES = "bodies.png"
"""The frames of all sensors with the poses of several bodies."""

_LARGE = (1400, 1050)  # room of a picture of its own
_SMALL = (460, 345)  # and on the sheet
_WIDTH = 4 * _SMALL[0] + 12
_BLURS_ON_SHEET = 4
_LEVELS_WITHOUT_POSE = 4
_RANGE_ROW, _LOW_RANGE_ROW = 210, 140  # px, of few and of many range sensors


def inspection_pictures(
    session: Session, tracked: TrackedBody, findings: Sequence[Finding], estimate: Estimate
) -> dict[str, Picture]:
    """Make all pictures of one body in one frame.

    Parameters
    ----------
    session : Session
    tracked : TrackedBody
        Of the body: how far from its pose a search begins, and with it the widest blur.
    findings : sequence of Finding
        One per sensor.
    estimate : Estimate

    Returns
    -------
    dict of str to (H, W, 3) uint8
        By file name, ``sheet.png`` first.
    """
    body = tracked.body
    views = [
        finding.view
        for finding in findings
        if finding.view is not None and not finding.view.observation.is_empty
    ]
    blurs = blur_levels(views, tracked, estimate)
    pictures: dict[str, Picture] = {}
    rows = [_heading(session, estimate)]
    names = file_names(_names(session))
    for finding, name in zip(findings, names, strict=True):
        if finding.setup.sensor.dimension != 2:
            continue
        sigmas = blurs.get(finding.name, [])
        made = _camera_pictures(finding, body, estimate, sigmas)
        pictures |= {f"{name}_{stage}.png": picture for stage, picture in made.items()}
        rows.append(_camera_row(finding, body, estimate, sigmas))
    ranged = [finding for finding in findings if finding.setup.sensor.dimension == 1]
    if ranged:
        ends = [_ends(blurs.get(finding.name, [])) for finding in ranged]
        height = _RANGE_ROW if len(ranged) <= 4 else _LOW_RANGE_ROW
        picture = ranges_picture(ranged, ends, body, estimate, session.unit, _WIDTH, height)
        pictures["ranges.png"] = picture
        rows.append(picture)
    if estimate.T_world_object is not None and views:
        pictures["objective.png"] = _objective(session, body, views, blurs, estimate)
        rows.append(pictures["objective.png"])
    return {"sheet.png": stacked(rows), **pictures}


def _objective(
    session: Session,
    body: Body,
    views: Sequence[View],
    blurs: Mapping[str, Sequence[float]],
    estimate: Estimate,
) -> Picture:
    T, covariance = estimate.T_world_object, estimate.covariance
    assert T is not None, "without a pose there is nothing to cut the objective around"
    levels = list(zip(*(blurs[view.name] for view in views), strict=True))
    slices, maps = objective_around(views, body, T, covariance, session.estimator, levels)
    factors = [max(a / b for a, b in zip(level, levels[-1])) for level in levels]
    return objective_picture(slices, maps, factors, covariance, session.unit, _WIDTH)


def possible_names(session: Session) -> list[str]:
    """Names of all files that may be made of a session's frame."""
    stages = ("features", "threshold", "density", "pose")
    names = [f"{name}_{stage}.png" for name in file_names(_names(session)) for stage in stages]
    names = ["sheet.png", "objective.png", "ranges.png", *names]
    prefixes = prefixes_of(session.labels)
    return [BODIES, *(prefix + name for prefix in prefixes for name in names)]


def prefixes_of(labels: Sequence[str]) -> list[str]:
    """What the names of a body's pictures begin with; nothing where it is the only one."""
    return [""] if len(labels) == 1 else [f"{name}_" for name in file_names(labels)]


def blur_levels(
    views: Sequence[View], tracked: TrackedBody, estimate: Estimate
) -> dict[str, list[float]]:
    """Blurs that the estimator descends through, coarse to fine, by sensor."""
    if not views:
        return {}
    if estimate.T_world_object is None:
        steps = range(_LEVELS_WITHOUT_POSE - 1, -1, -1)
        return {
            view.name: [view.observation.sigma * ScheduleRules().ratio ** k for k in steps]
            for view in views
        }
    around = np.where(tracked.free, tracked.start_uncertainty, 0.0)
    levels = blur_schedule(views, tracked.body, estimate.T_world_object, around)
    return {view.name: [level[k] for level in levels] for k, view in enumerate(views)}


def _camera_pictures(
    finding: Finding, body: Body, estimate: Estimate, sigmas: Sequence[float]
) -> dict[str, Picture]:
    pictures = {
        "features": features_picture(finding, _LARGE),
        "threshold": threshold_picture(finding, _LARGE),
        "pose": pose_picture(finding, body, estimate, _LARGE),
    }
    if finding.view is not None and sigmas:
        T = estimate.T_world_object
        pictures["density"] = densities_picture(
            finding.view, body, T, sigmas, (460, 460), min(len(sigmas), 4)
        )
    return pictures


def _camera_row(
    finding: Finding, body: Body, estimate: Estimate, sigmas: Sequence[float]
) -> Picture:
    """One camera on the sheet: features, threshold, densities, pose."""
    panels = [features_picture(finding, _SMALL), threshold_picture(finding, _SMALL)]
    if finding.view is not None and sigmas:
        chosen = np.unique(np.round(np.linspace(0, len(sigmas) - 1, _BLURS_ON_SHEET)).astype(int))
        half = _SMALL[0] // 2 - 2, _SMALL[1] // 2 - 2
        few = [sigmas[k] for k in chosen]
        T = estimate.T_world_object
        panels.append(densities_picture(finding.view, body, T, few, half, 2))
    panels.append(pose_picture(finding, body, estimate, _SMALL))
    return in_grid(panels, 4, _SMALL)


def _heading(session: Session, estimate: Estimate) -> Picture:
    """What the sheet is of, and what its marks mean."""
    picture = np.zeros((40, _WIDTH, 3), np.uint8)
    whose = f"{estimate.label} " if len(session.labels) > 1 else ""
    text = f"{session.path.name}, frame {estimate.frame}: {whose}"
    u = words(picture, text, (10, 27), WHITE, size=1.2)
    colour = STATUS_COLOURS[estimate.status]
    u = words(picture, f"{estimate.status}  ", (u + 8, 27), colour, size=1.2)
    if any(setup.sensor.dimension == 2 for setup in session.sensors):
        u = words(picture, "+ found", (u + 40, 27), FOUND)
        if estimate.T_world_object is not None:
            u = words(picture, "o where the pose has a feature, numbered", (u + 24, 27), colour)
            words(picture, "ellipse: its place with 95 %", (u + 24, 27), WHITE)
    return picture


def _ends(sigmas: Sequence[float]) -> list[float]:
    """The coarsest and the finest blur."""
    return list(dict.fromkeys([sigmas[0], sigmas[-1]])) if sigmas else []


def _names(session: Session) -> list[str]:
    return [setup.name for setup in session.sensors]


def file_names(wanted: Sequence[str]) -> list[str]:
    """Names that any file system takes, no two alike."""
    names: list[str] = []
    for one in wanted:
        name = re.sub(r"[^\w.-]", "_", one)
        taken = {one.casefold() for one in names}
        names.append(name if name.casefold() not in taken else f"{name}_{len(names)}")
    return names

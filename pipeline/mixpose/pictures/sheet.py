"""Draw all pictures of an inspected frame, and the sheet that combines them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from mixpose.body import Body
from mixpose.naming import distinct
from mixpose.objective import View
from mixpose.pictures import stages
from mixpose.pictures.canvas import WHITE, Picture, in_grid, stacked, words
from mixpose.pictures.finding import Finding
from mixpose.pictures.overlay import MEASURED, STATUS_COLOURS
from mixpose.pictures.plots import objective_around, objective_picture, ranges_picture
from mixpose.records import Estimate
from mixpose.session import Session

BODIES = "bodies.png"  # frames of all sensors with the poses of several bodies
STAGES = ("features", "threshold", "density", "pose")  # of a camera, in order on the sheet

_LARGE = (1400, 1050)  # room of a separate picture
_SMALL = (460, 345)  # room of a picture on the sheet
_WIDTH = 4 * _SMALL[0] + 12
_BLURS_ON_SHEET = 2
_BAR_PX = 72  # height of a title and a scale on the sheet, with the gaps
_MOST_BLURS = 8  # in a separate picture
_GAP_PX = 4
_RANGE_ROW, _LOW_RANGE_ROW = 210, 140  # px, of up to four and of more range sensors


def inspection_pictures(
    session: Session, body: Body, findings: Sequence[Finding], estimate: Estimate
) -> dict[str, Picture]:
    """Draw all pictures of one body in a frame, by file name; ``sheet.png`` is the first."""
    views = [finding.view for finding in findings if finding.view is not None]
    views = [view for view in views if not view.observation.is_empty]
    blurs = fitted_blurs(views, estimate)
    pictures: dict[str, Picture] = {}
    rows = [_heading(session, estimate)]
    names = file_names([setup.name for setup in session.sensors])
    for finding, name in zip(findings, names, strict=True):
        if finding.setup.sensor.dimension != 2:
            continue
        sigmas = blurs.get(finding.name, [])
        arguments = session, finding, body, estimate, sigmas
        by_stage = _camera_pictures(*arguments, on_sheet=False)
        pictures |= {f"{name}_{stage}.png": picture for stage, picture in by_stage.items()}
        by_stage = _camera_pictures(*arguments, on_sheet=True)
        rows.append(in_grid([by_stage[stage] for stage in STAGES if stage in by_stage], 4, _SMALL))
    ranged = [finding for finding in findings if finding.setup.sensor.dimension == 1]
    if ranged:
        ends = [_spaced_blurs(blurs.get(finding.name, []), _BLURS_ON_SHEET) for finding in ranged]
        height = _RANGE_ROW if len(ranged) <= 4 else _LOW_RANGE_ROW
        picture = ranges_picture(ranged, ends, body, estimate, session.unit, _WIDTH, height)
        pictures["ranges.png"] = picture
        rows.append(picture)
    T, covariance = estimate.T_world_object, estimate.covariance
    if T is not None and views:
        levels = list(zip(*(blurs[view.name] for view in views), strict=True))
        around = objective_around(views, body, T, covariance, session.estimator, levels)
        finest = [view.observation.sigma for view in views]
        factors = [max(a / b for a, b in zip(level, finest)) for level in levels]
        picture = objective_picture(*around, factors, covariance, session.unit, _WIDTH)
        pictures["objective.png"] = picture
        rows.append(picture)
    return {"sheet.png": stacked(rows), **pictures}


def possible_names(session: Session) -> list[str]:
    """Return the names of all files that an inspection of a frame may write."""
    sensors = file_names([setup.name for setup in session.sensors])
    names = [f"{name}_{stage}.png" for name in sensors for stage in STAGES]
    names = ["sheet.png", "objective.png", "ranges.png", *names]
    prefixes = prefixes_of(session.labels)
    return [BODIES, *(prefix + name for prefix in prefixes for name in names)]


def prefixes_of(labels: Sequence[str]) -> list[str]:
    """Return prefixes of the pictures' names by body; "" for the only body."""
    return [""] if len(labels) == 1 else [f"{name}_" for name in file_names(labels)]


def fitted_blurs(views: Sequence[View], estimate: Estimate) -> dict[str, list[float]]:
    """Return the blurs of a fit by sensor, in their order; σ_ε if a blur is not known."""
    levels = estimate.blurs or ({},)
    return {
        view.name: [level.get(view.name, view.observation.sigma) for level in levels]
        for view in views
    }


def _camera_pictures(
    session: Session,
    finding: Finding,
    body: Body,
    estimate: Estimate,
    sigmas: Sequence[float],
    *,
    on_sheet: bool,
) -> dict[str, Picture]:
    """Draw a camera's pictures by `STAGES`; no densities without blurs."""
    room = _SMALL if on_sheet else _LARGE
    pictures = {
        "features": stages.features_picture(finding, room),
        "threshold": stages.threshold_picture(finding, room),
        "pose": stages.pose_picture(finding, body, estimate, room),
    }
    if finding.view is not None and sigmas:
        few = _spaced_blurs(sigmas, _BLURS_ON_SHEET if on_sheet else _MOST_BLURS)
        side = min(_WIDTH // len(few) - _GAP_PX, _SMALL[0])
        panel = (_SMALL[0] // len(few) - 2, _SMALL[1] // 2 - _BAR_PX) if on_sheet else (side, side)
        arguments = finding.view, body, estimate.T_world_object, few, session.estimator
        pictures["density"] = stages.densities_picture(*arguments, panel)
    return pictures


def _heading(session: Session, estimate: Estimate) -> Picture:
    """Draw the title of the sheet, and the legend of its marks."""
    picture = np.zeros((40, _WIDTH, 3), np.uint8)
    whose = f"{estimate.label} " if len(session.labels) > 1 else ""
    text = f"{session.path.name}, frame {estimate.frame}: {whose}"
    u = words(picture, text, (10, 27), WHITE, size=1.2)
    colour = STATUS_COLOURS[estimate.status]
    u = words(picture, f"{estimate.status}  ", (u + 8, 27), colour, size=1.2)
    if any(setup.sensor.dimension == 2 for setup in session.sensors):
        u = words(picture, "+ found", (u + 40, 27), MEASURED)
        if estimate.T_world_object is not None:
            u = words(picture, "o where the pose has a feature, numbered", (u + 24, 27), colour)
            words(picture, "ellipse: its place with 95 %", (u + 24, 27), WHITE)
    return picture


def _spaced_blurs(sigmas: Sequence[float], most: int) -> list[float]:
    """Select at most so many blurs, evenly by number, with the first and the last."""
    chosen = np.unique(np.round(np.linspace(0, len(sigmas) - 1, most)).astype(int))
    return [sigmas[k] for k in chosen] if sigmas else []


def file_names(wanted: Sequence[str]) -> list[str]:
    """Convert names to distinct names that any file system allows."""
    return distinct(wanted, partial(re.sub, r"[^\w.-]", "_"), str.casefold)

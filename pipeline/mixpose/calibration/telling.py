"""A calibration in words: a table for people."""

from __future__ import annotations

import numpy as np

from mixpose.calibration import result
from mixpose.calibration.result import HELD_LENS, Calibration, Displacement
from mixpose.calibration.rig import Block, centre_of, values_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats
from mixpose.rigid import inverse, rotation_angle_deg

_WORST = 3
_ALONG = 0.2  # of how far sensors moved: so little is left where they only came nearer
_ROUNDING = 1e-9  # of a degree or a length unit
_CELLS = 4  # by which an image is divided along each side to tell its coverage


def lines_of(found: Calibration, unit: str) -> list[str]:
    """Lines of the report on a terminal."""
    lines = [_frames_line(found)]
    lines += [f"{'gauge':<10}{text}" for text in found.gauge]
    lines += [""]
    for block in found.blocks:
        lines += _block_lines(found, block, unit)
    if (scale := found.after.scale) != 1:
        lines.append(f"{'scale':<28}all lengths, the body's too, are {scale:.5g} times as large")
    lines += ["", *_residual_lines(found, unit), "", *_worst_lines(found)]
    lines += _coverage_lines(found)
    if found.inflation > 1:
        lines.append(
            f"{'spread':<10}frames differ {np.sqrt(found.inflation):.2g} times as much as errors "
            "of single detections would let them (motion, body or lens); deviations include it"
        )
    lines += _held_lines(found, unit)
    lines += [f"{'doubt':<10}{text}" for text in doubts_of(found, unit)]
    return lines + [f"{'refused':<10}not determined: {text}" for text in found.refused]


def _unit_of(found: Calibration, sensor: int, unit: str) -> str:
    return "px" if found.after.sensors[sensor].unit == "px" else unit


def _plus_minus(deviation: float, unit: str) -> str:
    return f"± {deviation:.2g} {unit}" if np.isfinite(deviation) else "not determined"


def _held_lines(found: Calibration, unit: str) -> list[str]:
    """What would do that is taken as exact, where it would do more than what is told."""
    lengths = np.array([unit == "length" for block in found.blocks for unit in block.units], bool)
    told, lines = np.where(np.isfinite(found.deviations) & lengths, found.deviations, np.inf), []
    lens = HELD_LENS
    for moved, words, kind in (
        (found.moved_by_biases, "range biases, as exact; off by extract.sigma each", "range_bias"),
        (
            found.moved_by_lenses,
            f"lenses, as exact; off by {100 * lens.focal:g} % of the focal length and by "
            f"{lens.principal_point:g} px of the principal point",
            "focal",
        ),
    ):
        # a coordinate that the gauge holds has no deviation, and is not moved
        worst = int(np.argmax(moved / np.maximum(told, 1e-300))) if len(moved) else 0
        if len(moved) and moved[worst] > told[worst]:
            lines.append(
                f"{'held':<10}{words} they would move what was found by {moved[worst]:.2g} {unit}, "
                f"told as ± {told[worst]:.2g} {unit}: state calibration_error, or free {kind}"
            )
    return lines + _held_size(found, unit)


def _held_size(found: Calibration, unit: str) -> list[str]:
    """What the size of the body would do, which alone tells cameras how far apart they stand."""
    cameras = [one for one in found.after.sensors if hasattr(one, "camera_matrix")]
    moved = [block for block in found.blocks if block.kind == "pose"]
    # of all of them it is told by poses that are known
    told_otherwise = found.after.scale != 1 or len(cameras) < len(found.after.sensors)
    if told_otherwise or not 0 < len(moved) < len(cameras):
        return []
    centres = np.array([centre_of(one) for one in cameras])
    by = 0.01 * float(np.linalg.norm(centres - centres[:, None], axis=2).max())
    return [
        f"{'held':<10}the size of the body, as exact; 1 % of it moves sensors by up to {by:.2g} "
        f"{unit}: --length tells it"
    ]


def doubts_of(found: Calibration, unit: str) -> list[str]:
    """What tells that the calibration may not be right, though it was found."""
    rules, told = CalibrationRules(), []
    if found.certainty < rules.certain:
        told.append(
            f"{100 * (1 - found.certainty):.0f} % of the matches could as well be others': "
            "detections do not tell features apart, so that the deviations hold only if the start "
            "was right"
        )
    scale = found.after.scale
    if abs(np.log(scale)) > rules.rescaled:
        told.append(
            f"by the length that is known the body is {scale:.3g} times as large as the session "
            "has it: is it the distance of these two, in the session's unit?"
        )
    held = found.contradicted
    if held is not None:
        told.append(
            f"the recording contradicts what is held of {held.words}, most of all {held.most}: "
            f"freed, it would move what was found by {held.moves:.2g} deviations, which do not "
            f"know of it; add --free {held.words} to what is free"
        )
    for sensor in found.doubtful(rules):
        told.append(
            f"{found.after.names[sensor]}: {100 * found.explained[sensor]:.0f} % of its detections "
            "fit: it may stand elsewhere"
        )
    for sensor, each in found.residuals.items():
        if each.held > rules.rising * each.after:
            of = _unit_of(found, sensor, unit)
            told.append(
                f"{found.after.names[sensor]}: the residual rises from {each.after:.3g} to "
                f"{each.held:.3g} {of} in the frames held back: the others are too few or "
                "too alike; record more"
            )
    return told + _doubt_of_size(found)


def _doubt_of_size(found: Calibration) -> list[str]:
    """That sensors only came nearer or farther apart, as where the body is of another size."""
    if found.after.scale != 1:
        return []
    each = [
        result.before_and_after(found.before, found.after, k) for k in range(len(found.after.names))
    ]
    poses = [pair for pair in each if pair is not None]
    told = [found.deviations[block.place][:3] for block in found.blocks if block.kind == "pose"]
    if len(poses) < 2 or not told:
        return []
    # centres in the axes of the first, by the old calibration and by the new one
    old, new = (
        np.array([(T[0] @ inverse(one))[:3, 3] for one in T[1:]]) for T in zip(*poses, strict=True)
    )
    scale = float(np.vdot(old, new) / max(float(np.vdot(old, old)), 1e-300))
    moved, left = np.linalg.norm(new - old), np.linalg.norm(new - scale * old)
    sure = CalibrationRules().moved * float(np.linalg.norm(told))
    if scale <= 0 or left > _ALONG * moved or not moved > sure:
        return []
    return [
        f"sensors are found {scale:.4g} times as far apart as the session has them, in the same "
        f"directions: is the body {1 / scale:.4g} times as large as [object] has it, or in another "
        "unit?"
    ]


def _frames_line(found: Calibration) -> str:
    parts = [f"{len(found.used)} calibrated from"]
    if any(np.isfinite(each.held) for each in found.residuals.values()):
        parts.append("each held back once")
    if found.bad:
        parts.append(f"{len(found.bad)} bad")
    rest = found.recorded - len(found.used) - len(found.bad)
    if rest > 0:
        parts.append(f"{rest} not needed or without the body")
    return f"{'frames':<10}{', '.join(parts)}"


def _block_lines(found: Calibration, block: Block, unit: str) -> list[str]:
    if block.sensor is None:
        return _body_lines(found, block, unit)
    if block.kind == "pose":
        return [_moved_line(found, block.sensor, found.deviations[block.place], unit)]
    name = found.after.names[block.sensor]
    before, after = values_of(found.before, block), values_of(found.after, block)
    lines = []
    for k, part in enumerate(block.names):
        of = unit if block.units[k] == "length" else block.units[k]
        scale, of = (1e3, "ms") if of == "s" else (1.0, of)
        deviation = found.deviations[block.start + k] * scale
        said = _plus_minus(deviation, of)
        title = f"{name} {block.kind}" + (f" {part}" if len(block.names) > 1 else "")
        lines.append(f"{title:<28}{before[k] * scale:>14.6g} -> {after[k] * scale:<14.6g}{said}")
    return lines


def _moved_line(found: Calibration, sensor: int, deviation: Floats, unit: str) -> str:
    one, two = (rig.sensors[sensor] for rig in (found.before, found.after))
    turn = float(rotation_angle_deg(one.T_sensor_world, two.T_sensor_world))  # type: ignore[attr-defined]
    shift = float(np.linalg.norm(centre_of(two) - centre_of(one)))
    words = []
    for part, of, scale in ((deviation[:3], unit, 1.0), (deviation[3:], "deg", 180 / np.pi)):
        total = np.sqrt((part**2).sum()) * scale
        words.append(f"{total:.2g} {of}" if np.isfinite(total) else "not determined")
    link = ""
    if sensor in found.through:
        via, frames = found.through[sensor]
        other = "known poses" if via is None else found.after.names[via]
        link = f"; linked through {other} in {frames} frames"
    title = f"{found.after.names[sensor]} pose"
    return f"{title:<28}turned by {turn:.4g} ± {words[1]}, moved by {shift:.5g} ± {words[0]}{link}"


def _body_lines(found: Calibration, block: Block, unit: str) -> list[str]:
    deviation = found.deviations[block.place].reshape(-1, 3)
    shift = np.linalg.norm(found.after.points - found.before.points, axis=1)
    lines = []
    for label, moved, each in zip(found.after.body.labels, shift, deviation, strict=True):
        said = _plus_minus(np.sqrt((each**2).sum()), unit)
        lines.append(f"{f'body feature {label}':<28}moved by {moved:.4g} {said}")
    return lines


def _residual_lines(found: Calibration, unit: str) -> list[str]:
    lines = [f"{'residual, RMS':<20}{'before':>10}{'after':>10}{'held back':>12}"]
    for sensor, each in found.residuals.items():
        of = _unit_of(found, sensor, unit)
        numbers = "".join(
            f"{value:>{width}.3g}" if np.isfinite(value) else f"{'–':>{width}}"
            for value, width in ((each.before, 10), (each.after, 10), (each.held, 12))
        )
        lines.append(f"{found.after.names[sensor]:<20}{numbers} {of}")
    return lines


def _worst_lines(found: Calibration) -> list[str]:
    """Frames and features that fit worst, by name."""
    lines = []
    for kind in ("frame", "feature"):
        keys, rms = result.residuals_by(found, kind)
        called = found.after.body.labels if kind == "feature" else dict(zip(keys, keys.astype(str)))
        typical = np.median(rms) if len(rms) else 1.0
        worst = np.lexsort((keys, -rms))[:_WORST]
        told = ", ".join(f"{called[keys[k]]} ({rms[k] / typical:.2g})" for k in worst)
        lines.append(f"{'worst':<10}{kind}s, by their residual over the median of all: {told}")
    return lines


def _coverage_lines(found: Calibration) -> list[str]:
    """In how many of 4 x 4 parts of each camera's image detections were met."""
    lines = []
    for sensor, (name, eye) in enumerate(zip(found.after.names, found.after.sensors, strict=True)):
        resolution = getattr(eye, "resolution", None)
        if eye.dimension != 2 or resolution is None:
            continue
        y = found.sights[sensor].y
        edges = [np.linspace(-0.5, size - 0.5, _CELLS + 1) for size in resolution]
        counts = np.histogram2d(y[:, 1], y[:, 0], bins=(edges[1], edges[0]))[0]
        empty = np.count_nonzero(counts == 0)
        said = f"{counts.size - empty} of {counts.size} parts of the image seen"
        if empty:
            said += f"; none at {_where(counts)}"
        lines.append(f"{'coverage':<10}{name}: {said}")
    return lines


def _where(counts: Floats) -> str:
    """Which sides of the image are empty, in words."""
    sides = {"top": counts[0], "bottom": counts[-1], "left": counts[:, 0], "right": counts[:, -1]}
    empty = [name for name, row in sides.items() if not row.any()]
    return ", ".join(empty) or "some corners or gaps"


def check_lines(found: Calibration, unit: str) -> list[str]:
    """Whether the calibration that a session has still holds, and which sensor was bumped."""
    told = result.displacements(found, CalibrationRules())
    bumped = [one.name for one in told if one.moved]
    are_told = 2 * len(bumped) < len(told)  # most of them agree
    lines = [_frames_line(found)]
    for one in told:
        of, before = _unit_of(found, one.sensor, unit), one.residual_before
        text = f"residual {before:.3g} {of}" if np.isfinite(before) else "meets nothing"
        lines.append(
            f"{one.name:<20}{_displaced(one, unit)}; {text}, calibrated anew "
            f"{one.residual_after:.3g} {of}" + ("  MOVED" if one.moved and are_told else "")
        )
    lines += [f"{'not known':<20}{found.after.names[k]}: shares no view" for k in found.unlinked]
    if len(found.after.names) < 2:
        lines.append("nothing to hold it against: one sensor alone shows where the body is")
    elif not bumped:
        lines.append("the calibration holds" + (", of what shares views" if found.unlinked else ""))
    elif are_told:
        lines.append(f"the calibration no longer holds: {', '.join(bumped)} moved")
    else:
        of = "two sensors" if len(told) == 2 else f"{len(told)} sensors most of which disagree"
        lines.append(f"the calibration no longer holds: of {of} no one can tell which moved")
    return [*lines, *(f"{'doubt':<10}{text}" for text in _doubt_of_size(found))]


def _displaced(one: Displacement, unit: str) -> str:
    """By how much a sensor is off; the one that is held is off by rounding errors only."""
    if one.turn_deg < _ROUNDING and one.shift < _ROUNDING * max(one.shift_deviation, 1.0):
        return "held, the others are told against it"
    return (
        f"turned by {one.turn_deg:.3g} ± {one.turn_deviation_deg:.2g} deg, moved by "
        f"{one.shift:.3g} ± {one.shift_deviation:.2g} {unit}"
    )

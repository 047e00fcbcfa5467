"""A calibration in words: the report on a terminal, doubts, and the lines of a check."""

from __future__ import annotations

import numpy as np

from mixpose.calibration import result
from mixpose.calibration.adjust import deviations_of
from mixpose.calibration.profile import Contradiction
from mixpose.calibration.result import HELD_LENS, Calibration, Displacement
from mixpose.calibration.rig import Block, Rig, centre_of, values_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats
from mixpose.rigid import inverse, rotation_angle_deg

_WORST = 3
_ALONG = 0.2  # of how far sensors moved: what a change of scale leaves of it at most
_ROUNDING = 1e-9  # of a degree or a length unit
_CELLS = 4  # along each side of an image, to count its coverage


def lines_of(calibration: Calibration, unit: str) -> list[str]:
    """Return the lines of the report on a terminal."""
    gauge, inflation = calibration.gauge, calibration.inflation
    lines = [_frames_line(calibration), *(f"{'gauge':<10}{text}" for text in gauge), ""]
    for block in calibration.blocks:
        lines += _block_lines(calibration, block, unit)
    if (scale := calibration.after.scale) != 1:
        lines.append(f"{'scale':<28}all lengths, the body's too, are {scale:.5g} times as large")
    lines += ["", *_residual_lines(calibration, unit), "", *_worst_lines(calibration)]
    lines += _coverage_lines(calibration)
    if inflation > 1:
        lines.append(
            f"{'spread':<10}frames differ {np.sqrt(inflation):.2g} times as much as errors "
            "of single detections would let them (motion, body or lens); deviations include it"
        )
    lines += _held_lines(calibration, unit)
    lines += [f"{'doubt':<10}{text}" for text in doubts_of(calibration, unit)]
    return lines + [f"{'refused':<10}not determined: {text}" for text in calibration.refused]


def _unit_of(rig: Rig, sensor: int, unit: str) -> str:
    return "px" if rig.sensors[sensor].unit == "px" else unit


def _plus_minus(deviation: float, unit: str) -> str:
    return f"± {deviation:.2g} {unit}" if np.isfinite(deviation) else "not determined"


def _held_lines(calibration: Calibration, unit: str) -> list[str]:
    """Name held errors that would move a parameter by more than its reported deviation."""
    lens, lines, deviations = HELD_LENS, list[str](), calibration.deviations
    biases, lenses = map(deviations_of, (calibration.of_biases, calibration.of_lenses))
    is_length = np.array([u == "length" for block in calibration.blocks for u in block.units], bool)
    reported = np.where(np.isfinite(deviations) & is_length, deviations, np.inf)
    for moved, words, kind in (
        (biases, "range biases, as exact; off by extract.sigma each", "range_bias"),
        (
            lenses,
            f"lenses, as exact; off by {100 * lens.focal:g} % of the focal length and by "
            f"{lens.principal_point:g} px of the principal point",
            "focal",
        ),
    ):
        # a parameter that the gauge holds has no deviation, and is not moved
        worst = int(np.argmax(moved / np.maximum(reported, 1e-300))) if len(moved) else 0
        if len(moved) and moved[worst] > reported[worst]:
            lines.append(
                f"{'held':<10}{words} they would move what was found by {moved[worst]:.2g} {unit}, "
                f"told as ± {reported[worst]:.2g} {unit}: state calibration_error, or free {kind}"
            )
    return lines + _held_size(calibration.after, calibration.blocks, unit)


def _held_size(rig: Rig, blocks: tuple[Block, ...], unit: str) -> list[str]:
    """Say how an error of the body's size moves cameras, if only that size gives the scale."""
    cameras = [sensor for sensor in rig.sensors if hasattr(sensor, "camera_matrix")]
    moved = [block for block in blocks if block.kind == "pose"]
    # if all cameras are moved, known poses give the scale
    has_other_scale = rig.scale != 1 or len(cameras) < len(rig.sensors)
    if has_other_scale or not 0 < len(moved) < len(cameras):
        return []
    centres = np.array([centre_of(camera) for camera in cameras])
    by = 0.01 * float(np.linalg.norm(centres - centres[:, None], axis=2).max())
    return [
        f"{'held':<10}the size of the body, as exact; 1 % of it moves sensors by up to {by:.2g} "
        f"{unit}: --length tells it"
    ]


def doubts_of(calibration: Calibration, unit: str) -> list[str]:
    """Return sentences for all that casts doubt on a calibration."""
    rules, rig, doubts = CalibrationRules(), calibration.after, []
    if calibration.certainty < rules.certain:
        doubts.append(
            f"{100 * (1 - calibration.certainty):.0f} % of the matches could as well be others': "
            "detections do not tell features apart, so that the deviations hold only if the start "
            "was right"
        )
    scale = rig.scale
    if abs(np.log(scale)) > rules.rescaled:
        doubts.append(
            f"by the length that is known the body is {scale:.3g} times as large as the session "
            "has it: is it the distance of these two, in the session's unit?"
        )
    if calibration.contradicted is not None:
        doubts.append(_contradiction(calibration.contradicted))
    for sensor in calibration.doubtful(rules):
        doubts.append(
            f"{rig.names[sensor]}: {100 * calibration.explained[sensor]:.0f} % of its detections "
            "fit: it may stand elsewhere"
        )
    for sensor, residual in calibration.residuals.items():
        if residual.held > rules.rising * residual.after:
            own_unit = _unit_of(rig, sensor, unit)
            doubts.append(
                f"{rig.names[sensor]}: the residual rises from {residual.after:.3g} to "
                f"{residual.held:.3g} {own_unit} in the frames held back: the others are too few "
                "or too alike; record more"
            )
    return doubts + _doubt_of_size(calibration)


def _contradiction(contradicted: Contradiction) -> str:
    """Say what the recording contradicts, and what to do."""
    name, deviations = " or ".join(contradicted.names), f"{contradicted.deviations:.2g} deviations"
    if contradicted.frames is not None:
        first, last = contradicted.frames
        if not name:
            return (
                "what frames tell changes in the course of the recording by more than deviations "
                f"know of, most of all with frame {first}: a body that bends, a lens that is off, "
                "sensors that drift or were bumped more than once"
            )
        off = f"What was found is off by {deviations} or so, which do not know of it. "
        return (
            f"{name} stands elsewhere in frames {first} to {last} than in the others: was it "
            f"bumped? {off * bool(contradicted.deviations)}Record anew, or calibrate from those "
            "frames or the others alone"
        )
    return (
        f"the recording contradicts what is held of {name}, most of all {contradicted.parameter}: "
        f"freed, it would move what was found by {deviations}, which do not know of it; add --free "
        f"{name} to what is free"
    )


def _doubt_of_size(calibration: Calibration) -> list[str]:
    """Return a doubt of the body's size, if sensors only came nearer or farther apart."""
    if calibration.after.scale != 1:
        return []
    rigs, deviations = (calibration.before, calibration.after), calibration.deviations
    pairs = [result.before_and_after(*rigs, k) for k in range(len(rigs[0].names))]
    poses = [pair for pair in pairs if pair is not None]
    shifts = [deviations[b.place][:3] for b in calibration.blocks if b.kind == "pose"]
    if len(poses) < 2 or not shifts:
        return []
    # centres in the axes of the first sensor, by the old calibration and by the new one
    old, new = (
        np.array([(T[0] @ inverse(T_k))[:3, 3] for T_k in T[1:]]) for T in zip(*poses, strict=True)
    )
    scale = float(np.vdot(old, new) / max(float(np.vdot(old, old)), 1e-300))
    moved, unscaled = np.linalg.norm(new - old), np.linalg.norm(new - scale * old)
    limit = CalibrationRules().moved * float(np.linalg.norm(shifts))
    if scale <= 0 or unscaled > _ALONG * moved or not moved > limit:
        return []
    return [
        f"sensors are found {scale:.4g} times as far apart as the session has them, in the same "
        f"directions: is the body {1 / scale:.4g} times as large as [object] has it, or in another "
        "unit?"
    ]


def _frames_line(calibration: Calibration) -> str:
    parts = [f"{len(calibration.used)} calibrated from"]
    if any(np.isfinite(residual.held) for residual in calibration.residuals.values()):
        parts.append("each held back once")
    if calibration.bad:
        parts.append(f"{len(calibration.bad)} bad")
    unused = calibration.recorded - len(calibration.used) - len(calibration.bad)
    if unused > 0:
        parts.append(f"{unused} not needed or without the body")
    return f"{'frames':<10}{', '.join(parts)}"


def _block_lines(calibration: Calibration, block: Block, unit: str) -> list[str]:
    if block.sensor is None:
        return _body_lines(calibration, block, unit)
    if block.kind == "pose":
        return [_moved_line(calibration, block.sensor, calibration.deviations[block.place], unit)]
    sensor_name = calibration.after.names[block.sensor]
    before, after = values_of(calibration.before, block), values_of(calibration.after, block)
    lines = []
    for k, name in enumerate(block.names):
        own_unit = unit if block.units[k] == "length" else block.units[k]
        scale, own_unit = (1e3, "ms") if own_unit == "s" else (1.0, own_unit)
        sigma = _plus_minus(calibration.deviations[block.start + k] * scale, own_unit)
        title = f"{sensor_name} {block.kind}" + (f" {name}" if len(block.names) > 1 else "")
        lines.append(f"{title:<28}{before[k] * scale:>14.6g} -> {after[k] * scale:<14.6g}{sigma}")
    return lines


def _moved_line(calibration: Calibration, sensor: int, sigmas: Floats, unit: str) -> str:
    old, new = (rig.sensors[sensor] for rig in (calibration.before, calibration.after))
    turn = float(rotation_angle_deg(old.T_sensor_world, new.T_sensor_world))  # type: ignore[attr-defined]
    shift = float(np.linalg.norm(centre_of(new) - centre_of(old)))
    texts = []
    for part, own_unit, scale in ((sigmas[:3], unit, 1.0), (sigmas[3:], "deg", 180 / np.pi)):
        total = np.sqrt((part**2).sum()) * scale
        texts.append(f"{total:.2g} {own_unit}" if np.isfinite(total) else "not determined")
    link, names = "", calibration.after.names
    if sensor in calibration.through:
        via, frames = calibration.through[sensor]
        other = "known poses" if via is None else names[via]
        link = f"; linked through {other} in {frames} frames"
    title = f"{names[sensor]} pose"
    return f"{title:<28}turned by {turn:.4g} ± {texts[1]}, moved by {shift:.5g} ± {texts[0]}{link}"


def _body_lines(calibration: Calibration, block: Block, unit: str) -> list[str]:
    deviations = calibration.deviations[block.place].reshape(-1, 3)
    rig, lines = calibration.after, []
    shifts = np.linalg.norm(rig.points - calibration.before.points, axis=1)
    for label, shift, sigmas in zip(rig.body.labels, shifts, deviations, strict=True):
        deviation_text = _plus_minus(np.sqrt((sigmas**2).sum()), unit)
        lines.append(f"{f'body feature {label}':<28}moved by {shift:.4g} {deviation_text}")
    return lines


def _residual_lines(calibration: Calibration, unit: str) -> list[str]:
    lines = [f"{'residual, RMS':<20}{'before':>10}{'after':>10}{'held back':>12}"]
    for sensor, residual in calibration.residuals.items():
        own_unit = _unit_of(calibration.after, sensor, unit)
        numbers = "".join(
            f"{value:>{width}.3g}" if np.isfinite(value) else f"{'–':>{width}}"
            for value, width in ((residual.before, 10), (residual.after, 10), (residual.held, 12))
        )
        lines.append(f"{calibration.after.names[sensor]:<20}{numbers} {own_unit}")
    return lines


def _worst_lines(calibration: Calibration) -> list[str]:
    """Return the names of the frames and features that fit worst."""
    names, lines = calibration.after.body.labels, []
    for kind in ("frame", "feature"):
        keys, rms = result.residuals_by(calibration, kind)
        labels = names if kind == "feature" else dict(zip(keys, keys.astype(str)))
        typical = np.median(rms) if len(rms) else 1.0
        worst = np.lexsort((keys, -rms))[:_WORST]
        listed = ", ".join(f"{labels[keys[k]]} ({rms[k] / typical:.2g})" for k in worst)
        lines.append(f"{'worst':<10}{kind}s, by their residual over the median of all: {listed}")
    return lines


def _coverage_lines(calibration: Calibration) -> list[str]:
    """Return in how many of 4 x 4 parts of each camera's image detections were met."""
    rig, lines = calibration.after, []
    for index, (name, sensor) in enumerate(zip(rig.names, rig.sensors, strict=True)):
        resolution = getattr(sensor, "resolution", None)
        if sensor.dimension != 2 or resolution is None:
            continue
        y = calibration.met[index].y
        edges = [np.linspace(-0.5, size - 0.5, _CELLS + 1) for size in resolution]
        counts = np.histogram2d(y[:, 1], y[:, 0], bins=(edges[1], edges[0]))[0]
        empty = np.count_nonzero(counts == 0)
        coverage = f"{counts.size - empty} of {counts.size} parts of the image seen"
        if empty:
            coverage += f"; none at {_empty_sides(counts)}"
        lines.append(f"{'coverage':<10}{name}: {coverage}")
    return lines


def _empty_sides(counts: Floats) -> str:
    """Name the sides of the image that are empty."""
    sides = {"top": counts[0], "bottom": counts[-1], "left": counts[:, 0], "right": counts[:, -1]}
    empty = [name for name, row in sides.items() if not row.any()]
    return ", ".join(empty) or "some corners or gaps"


def check_lines(calibration: Calibration, unit: str) -> list[str]:
    """Return lines on whether a session's calibration still holds, and which sensor was bumped."""
    rig, unlinked = calibration.after, calibration.unlinked
    sensors = result.displacements(calibration, CalibrationRules())
    bumped = [sensor.name for sensor in sensors if sensor.moved]
    is_decided = 2 * len(bumped) < len(sensors)  # most sensors agree
    lines = [_frames_line(calibration)]
    for sensor in sensors:
        own_unit, before = _unit_of(rig, sensor.sensor, unit), sensor.residual_before
        text = f"residual {before:.3g} {own_unit}" if np.isfinite(before) else "meets nothing"
        lines.append(
            f"{sensor.name:<20}{_displaced(sensor, unit)}; {text}, calibrated anew "
            f"{sensor.residual_after:.3g} {own_unit}{'  MOVED' * (sensor.moved and is_decided)}"
        )
    lines += [f"{'not known':<20}{rig.names[k]}: shares no view" for k in unlinked]
    if len(rig.names) < 2:
        lines.append("nothing to hold it against: one sensor alone shows where the body is")
    elif not bumped:
        lines.append("the calibration holds" + (", of what shares views" if unlinked else ""))
    elif is_decided:
        lines.append(f"the calibration no longer holds: {', '.join(bumped)} moved")
    else:
        count = len(sensors)
        all_ = "two sensors" if count == 2 else f"{count} sensors most of which disagree"
        lines.append(f"the calibration no longer holds: of {all_} no one can tell which moved")
    return [*lines, *(f"{'doubt':<10}{text}" for text in _doubt_of_size(calibration))]


def _displaced(sensor: Displacement, unit: str) -> str:
    """Say how far a sensor is off; one that is held is off by rounding errors only."""
    if sensor.turn_deg < _ROUNDING and sensor.shift < _ROUNDING * max(sensor.shift_deviation, 1.0):
        return "held, the others are told against it"
    return (
        f"turned by {sensor.turn_deg:.3g} ± {sensor.turn_deviation_deg:.2g} deg, moved by "
        f"{sensor.shift:.3g} ± {sensor.shift_deviation:.2g} {unit}"
    )

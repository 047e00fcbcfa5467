"""A study as a table for people and as JSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mixpose.body import LookAlike
from mixpose.design.confirmation import Confirmation
from mixpose.design.prediction import Plan
from mixpose.design.study import Equal, Study, System
from mixpose.design.summary import Summary, Weakness, pooled
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES
from mixpose.sensors import RangeSensor, Sensor

_DEGREES = 180 / np.pi
_CROWDED = 0.05  # of the features: fewer hardly show in the errors
_NARROW, _FILLED = 0.4, 1.1  # of sigma: for cameras, and for ranges, which err by sigma
_WORTHWHILE = 0.05  # of an error, to be told
_NOTED = 3  # look-alikes and poses that are listed


def study_text(study: Study) -> str:
    """Lines for people."""
    count = len(study.request.poses)
    tip = study.request.tip
    point = "the origin" if tip is None else f"the tip {_vector(tip)} {study.unit}"
    lines = [f"{count} pose{'s' * (count != 1)}; errors of {point} are root mean squares"]
    for system in study.systems:
        lines += ["", *_system_lines(system, study)]
    if len(study.systems) > 1:
        lines += ["", *_comparison(study)]
    for alike in study.congruences:
        lines += ["", _congruence_text(alike, study.unit)]
    return "\n".join(lines) + "\n"


def _system_lines(system: System, study: Study) -> list[str]:
    summary, plan, unit = system.summary, system.plan, study.unit
    lines = [f"{system.name}: {_errs_text(plan, plan.noises, unit)}"]

    def say(title: str, text: str) -> None:
        lines.append(f"  {title:<10}{text}")

    say("deviation", _deviations_text(summary, plan, unit))
    say("error", _errors_text(summary, unit, with_tip=study.request.tip is not None))
    for what, weakness, each, scale in (
        ("weakest", summary.weakest_position, unit, 1.0),
        ("", summary.weakest_rotation, "deg", _DEGREES),
    ):
        if weakness is not None:
            say(what, _weakness_text(weakness, each, scale))
    if summary.undetermined:
        listed = ", ".join(map(str, summary.undetermined[:_NOTED]))
        more = ", ..." if len(summary.undetermined) > _NOTED else ""
        say("open", f"not determined at {len(summary.undetermined)} poses: {listed}{more}")
    rows = zip(plan.names, summary.seen, summary.fewest, strict=True)
    say("in view", ", ".join(f"{n} {s:.0%} (least {f} of {len(plan.body)})" for n, s, f in rows))
    crowded = [(n, c) for n, c in zip(plan.names, summary.crowded, strict=True) if c > _CROWDED]
    if crowded:
        told = ", ".join(f"{n} {c:.0%}" for n, c in crowded)
        say(
            "crowded", f"features nearer than 4 deviations to another: {told}; expect larger errors"
        )
    narrow = [
        (n, share)
        for n, share, sensor in zip(plan.names, summary.narrow, plan.sensors, strict=True)
        if share > (_FILLED if sensor.unit == "length" else _NARROW)
    ]
    if narrow:
        told = ", ".join(f"{n} {share:.2g}" for n, share in narrow)
        say("sigma", f"features err by much of sigma: {told} of it; raise sigma in [extract]")
    if system.weighed < (1 - _WORTHWHILE) * system.error:
        largest = max(plan.noises)
        told = ", ".join(f"{n} {e / largest:.2g}" for n, e in zip(plan.names, plan.noises))
        gain = _gain(system.weighed, system.error)
        say("weights", f"sigma in proportion to what features err by ({told}) gains {gain}")
    say("alike", _alike_text(summary))
    if system.confirmation is not None:
        say("simulated", _confirmation_text(system.confirmation, plan))
    if system.move is not None:
        name, gain = plan.body.labels[system.move.marker], _gain(system.move.error, system.error)
        say("marker", f"moving {name} by {_vector(system.move.shift)} {unit} gains {gain}")
    if system.new is not None:
        gain = _gain(system.new.error, system.error)
        say("sensor", f"one more like {system.new.like} {_place(system.new.sensor)} gains {gain}")
    return lines


def _errs_text(plan: Plan, noises: tuple[float, ...], unit: str) -> str:
    parts = [
        f"{name} {noise:.3g} {'px' if sensor.unit == 'px' else unit}"
        for name, noise, sensor in zip(plan.names, noises, plan.sensors, strict=True)
    ]
    markers = f"; markers err by {plan.body.spread:.3g} {unit}" if plan.body.spread else ""
    return f"features err by {', '.join(parts)}{markers}"


def _deviations_text(summary: Summary, plan: Plan, unit: str) -> str:
    parts = []
    for k in np.flatnonzero(plan.free):
        scale, each = (1.0, unit) if k < 3 else (_DEGREES, "deg")
        values = summary.deviations[:, k] * scale
        parts.append(
            f"{TWIST_NAMES[k]} {_number(np.median(values))}/{_number(values.max())} {each}"
        )
    return f"median/worst: {', '.join(parts)}"


def _errors_text(summary: Summary, unit: str, *, with_tip: bool) -> str:
    parts = [
        f"position {_number(pooled(summary.position))} {unit}",
        f"rotation {_number(pooled(summary.rotation) * _DEGREES)} deg",
    ]
    if with_tip:
        worst = _number(summary.tip.max())
        parts.append(f"tip {_number(pooled(summary.tip))} {unit} (worst {worst})")
    return ", ".join(parts)


def _weakness_text(weakness: Weakness, unit: str, scale: float) -> str:
    kind = "turns about" if scale != 1 else "along"
    times = "" if math.isinf(weakness.ratio) else f", {weakness.ratio:.2g} times the best direction"
    return (
        f"{kind} {_vector(weakness.direction)}: {_number(weakness.deviation * scale)} {unit} at "
        f"pose {weakness.pose}{times}"
    )


def _alike_text(summary: Summary) -> str:
    parts = ["no symmetry"]
    if summary.symmetries > 1:
        parts = [f"{summary.symmetries} orientations look the same"]
    for other in summary.alike[:_NOTED]:
        parts.append(
            f"another pose turned by {other.turn_deg:.0f} deg looks nearly the same, "
            f"{other.difference:.1f} deviations apart"
        )
    return "; ".join(parts)


def _confirmation_text(found: Confirmation, plan: Plan) -> str:
    statuses = ", ".join(f"{n} {status}" for status, n in sorted(found.statuses.items()))
    ratios = ", ".join(f"{TWIST_NAMES[k]} {found.ratios[k]:.3f}" for k in np.flatnonzero(plan.free))
    return (
        f"{found.frames} frames ({statuses}): errors are {found.overall:.3f} times the predicted "
        f"(by chance 1 ± {found.chance:.3f}); {ratios}"
    )


def _comparison(study: Study) -> list[str]:
    first = study.systems[0]
    names = [system.name for system in study.systems]
    width = max(12, *(len(name) + 2 for name in names))
    rows: list[tuple[str, list[str]]] = [("", names)]

    def add(title: str, errors: list[Floats], scale: float) -> None:
        rows.append((title, [_number(pooled(error) * scale) for error in errors]))

    summaries = [system.summary for system in study.systems]
    add(f"position, {study.unit}", [one.position for one in summaries], 1.0)
    add("rotation, deg", [one.rotation for one in summaries], _DEGREES)
    if study.request.tip is not None:
        add(f"tip, {study.unit}", [one.tip for one in summaries], 1.0)
    lines = [f"{title:<16}" + "".join(f"{cell:>{width}}" for cell in row) for title, row in rows]
    for system in study.systems[1:]:
        assert system.equal is not None, "all but the first are compared"
        lines.append(_equal_text(system, system.equal, first.name, study.unit))
    return lines


def _equal_text(system: System, equal: Equal, first: str, unit: str) -> str:
    if equal.factor is None:
        return f"{system.name} cannot equal {first}, whatever its detections err by"
    text = (
        f"{system.name} equals {first} ({_number(equal.wanted)} {unit}) with "
        f"{_errs_text(system.plan, equal.noises, unit)}: {equal.factor:.3g} times its noise"
    )
    if equal.confirmation is not None:
        text += f"; simulated: {_number(equal.confirmation.found[2])} {unit}"
    return text


def _congruence_text(alike: LookAlike, unit: str) -> str:
    ours = ", ".join(alike.body.labels[i] for i in alike.features)
    theirs = ", ".join(alike.other.labels[j] for j in alike.partners)
    return (
        f"{len(alike.features)} markers of {alike.body.name} ({ours}) lie like those of "
        f"{alike.other.name} ({theirs}), to {_number(alike.off)} {unit}: one body may be taken "
        "for the other; move one of them"
    )


def _gain(error: float, before: float) -> str:
    return f"{1 - error / before:.0%}" if math.isfinite(before) else "what is not determined"


def _place(sensor: Sensor) -> str:
    if isinstance(sensor, RangeSensor):
        return f"at {_vector(sensor.position)}"
    T: Floats = sensor.T_sensor_world  # type: ignore[attr-defined]
    centre = -T[:3, :3].T @ T[:3, 3]
    return f"at {_vector(centre)} that looks along {_vector(T[2, :3])}"


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "open"


def _vector(values: Floats) -> str:
    largest = float(np.abs(values).max())
    shown = [0.0 if abs(v) < 5e-3 * largest else float(f"{v:.3g}") for v in values]
    return f"({', '.join(f'{v:g}' for v in shown)})"


JSON_MARK = '"type": "design"'
"""What the numbers of a study begin with, by which mixpose knows its own files."""


def study_json(study: Study) -> dict[str, Any]:
    """The same as JSON; what is not determined is null."""
    return {
        "type": "design",
        "unit": study.unit,
        "tip": None if study.request.tip is None else study.request.tip.tolist(),
        "poses": study.request.poses.tolist(),
        "systems": [_system_json(system) for system in study.systems],
        "congruent": [
            {
                "bodies": [alike.body.name, alike.other.name],
                "markers": [
                    list(pair) for pair in zip(alike.features, alike.partners, strict=True)
                ],
                "misfit": alike.off,
            }
            for alike in study.congruences
        ],
    }


def _system_json(system: System) -> dict[str, Any]:
    summary, plan = system.summary, system.plan
    result: dict[str, Any] = {
        "name": system.name,
        "noise": dict(zip(plan.names, plan.noises, strict=True)),
        "error": _finite(system.error),
        "error_if_weighed": _finite(system.weighed),
        "deviations": [[_finite(v) for v in row] for row in summary.deviations],
        "position": [_finite(v) for v in summary.position],
        "rotation": [_finite(v) for v in summary.rotation],
        "tip": [_finite(v) for v in summary.tip],
        "seen": dict(zip(plan.names, summary.seen.tolist(), strict=True)),
        "of_sigma": dict(zip(plan.names, summary.narrow.tolist(), strict=True)),
        "crowded": dict(zip(plan.names, summary.crowded.tolist(), strict=True)),
        "undetermined": list(summary.undetermined),
        "symmetries": summary.symmetries,
        "alike": [
            {"turn_deg": other.turn_deg, "deviations_apart": other.difference}
            for other in summary.alike
        ],
    }
    for key, weakness in (
        ("weakest_position", summary.weakest_position),
        ("weakest_rotation", summary.weakest_rotation),
    ):
        result[key] = None if weakness is None else _weakness_json(weakness)
    if system.confirmation is not None:
        result["simulated"] = _confirmation_json(system.confirmation)
    if system.equal is not None:
        result["equals_first_with"] = _equal_json(system.equal, plan)
    if system.move is not None:
        move = system.move
        result["move_marker"] = {
            "marker": plan.body.labels[move.marker],
            "shift": move.shift.tolist(),
            "error": _finite(move.error),
        }
    if system.new is not None:
        sensor = system.new.sensor
        place: dict[str, Any] = {"like": system.new.like, "error": _finite(system.new.error)}
        if isinstance(sensor, RangeSensor):
            place["position"] = sensor.position.tolist()
        else:
            place["T_sensor_world"] = sensor.T_sensor_world.tolist()  # type: ignore[attr-defined]
        result["new_sensor"] = place
    return result


def _weakness_json(weakness: Weakness) -> dict[str, Any]:
    return {
        "pose": weakness.pose,
        "deviation": weakness.deviation,
        "direction": weakness.direction.tolist(),
        "ratio": _finite(weakness.ratio),
    }


def _confirmation_json(found: Confirmation) -> dict[str, Any]:
    names = ("position", "rotation", "tip")
    return {
        "frames": found.frames,
        "statuses": found.statuses,
        "ratios": [_finite(v) for v in found.ratios],
        "overall": _finite(found.overall),
        "chance": found.chance,
        "predicted": dict(zip(names, found.predicted.tolist(), strict=True)),
        "found": dict(zip(names, found.found.tolist(), strict=True)),
    }


def _equal_json(equal: Equal, plan: Plan) -> dict[str, Any]:
    result: dict[str, Any] = {"factor": equal.factor, "error": _finite(equal.wanted)}
    if equal.factor is not None:
        result["noise"] = dict(zip(plan.names, equal.noises, strict=True))
    if equal.confirmation is not None:
        result["simulated"] = _confirmation_json(equal.confirmation)
    return result


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

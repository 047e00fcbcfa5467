"""A study as a table for people and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from mixpose.body import LookAlike
from mixpose.design.confirmation import Confirmation, plain
from mixpose.design.prediction import Plan, Summary, Weakness, pooled
from mixpose.design.study import Equal, Study, System
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES, inverse
from mixpose.sensors import RangeSensor, Sensor

_DEGREES = 180 / np.pi
_CROWDED = 0.05  # of the features: a smaller share hardly shows in the errors
_NARROW, _FILLED = 0.4, 1.1  # of sigma: for cameras, and for ranges, whose noise is sigma
_WORTHWHILE = 0.05  # least gain of an error that is reported
_NOTED = 3  # look-alikes and poses that are listed


def study_text(study: Study) -> str:
    """Return a study as lines for people."""
    count, tip = len(study.request.poses), study.request.tip
    point = "the origin" if tip is None else f"the tip {_vector(tip)} {study.unit}"
    lines = [f"{count} pose{'s' * (count != 1)}; errors of {point} are root mean squares"]
    for system in study.systems:
        noises = _noise_text(system.plan, system.plan.noises, study.unit)
        lines += ["", f"{system.name}: {noises}"]
        lines += [f"  {title:<10}{text}" for title, text in _system_lines(system, study)]
    if len(study.systems) > 1:
        lines += ["", *_comparison(study)]
    for congruence in study.congruences:
        lines += ["", _congruence_text(congruence, study.unit)]
    return "\n".join(lines) + "\n"


def _system_lines(system: System, study: Study) -> Iterator[tuple[str, str]]:
    """Yield titles and texts of a system's lines."""
    summary, plan, unit = system.summary, system.plan, study.unit
    yield "deviation", _deviations_text(summary, plan, unit)
    worst = f" (worst {_number(summary.tip.max())})" if study.request.tip is not None else ""
    yield "error", ", ".join(map(" ".join, _errors(summary, study))) + worst
    if summary.weakest_position is not None:
        yield "weakest", _weakness_text(summary.weakest_position, unit, 1.0)
    if summary.weakest_rotation is not None:
        yield "", _weakness_text(summary.weakest_rotation, "deg", _DEGREES)
    if summary.undetermined:
        listed = ", ".join(map(str, summary.undetermined[:_NOTED]))
        more = ", ..." if len(summary.undetermined) > _NOTED else ""
        count = len(summary.undetermined)
        yield "open", f"not determined at {count} pose{'s' * (count != 1)}: {listed}{more}"
    yield from _sensor_lines(system)
    yield "alike", _alike_text(summary)
    if system.confirmation is not None:
        yield "simulated", _confirmation_text(system.confirmation, plan)
    elif study.request.runs:
        yield "simulated", "nothing: no pose is determined"
    if system.move is not None:
        name, gain = plan.body.labels[system.move.marker], _gain(system.move.error, system.error)
        yield "marker", f"moving {name} by {_vector(system.move.shift)} {unit} gains {gain}"
    if system.new is not None:
        like, place = system.new.like, _place(system.new.sensor)
        gain = _gain(system.new.error, system.error)
        yield "sensor", f"one more like {like} {place} gains {gain}"


def _sensor_lines(system: System) -> Iterator[tuple[str, str]]:
    """Yield titles and texts on views of sensors, crowded features, and `sigma`."""
    summary, plan = system.summary, system.plan
    seen = zip(plan.names, summary.seen, summary.fewest, strict=True)
    yield "in view", ", ".join(f"{n} {s:.0%} (least {f} of {len(plan.body)})" for n, s, f in seen)
    crowded = [f"{n} {c:.0%}" for n, c in zip(plan.names, summary.crowded) if c > _CROWDED]
    if crowded:
        shares = f"{', '.join(crowded)}; expect larger errors"
        yield "crowded", f"features nearer than 4 deviations to another: {shares}"
    most = [_FILLED if sensor.unit == "length" else _NARROW for sensor in plan.sensors]
    rows = zip(plan.names, summary.narrow, most, strict=True)
    narrow = [f"{name} {share:.2g}" for name, share, limit in rows if share > limit]
    if narrow:
        shares = f"{', '.join(narrow)} of it; raise sigma in [extract]"
        yield "sigma", f"features err by much of sigma: {shares}"
    if system.weighed < (1 - _WORTHWHILE) * system.error:
        largest = max(plan.noises)
        shares = ", ".join(f"{n} {e / largest:.2g}" for n, e in zip(plan.names, plan.noises))
        gain = _gain(system.weighed, system.error)
        yield "weights", f"sigma in proportion to what features err by ({shares}) gains {gain}"


def _noise_text(plan: Plan, noises: tuple[float, ...], unit: str) -> str:
    parts = [
        f"{name} {noise:.3g} {'px' if sensor.unit == 'px' else unit}"
        for name, noise, sensor in zip(plan.names, noises, plan.sensors, strict=True)
    ]
    markers = f"; markers err by {plan.body.spread:.3g} {unit}" if plan.body.spread else ""
    return f"features err by {', '.join(parts)}{markers}"


def _deviations_text(summary: Summary, plan: Plan, unit: str) -> str:
    parts = []
    for k in np.flatnonzero(plan.free):
        scale, own_unit = (1.0, unit) if k < 3 else (_DEGREES, "deg")
        values = summary.deviations[:, k] * scale
        parts.append(
            f"{TWIST_NAMES[k]} {_number(np.median(values))}/{_number(values.max())} {own_unit}"
        )
    return f"median/worst: {', '.join(parts)}"


def _errors(summary: Summary, study: Study) -> list[tuple[str, str, str]]:
    """Return what errs, by how much, and in which unit; last the tip, if there is one."""
    errors = [
        ("position", _number(pooled(summary.position)), study.unit),
        ("rotation", _number(pooled(summary.rotation) * _DEGREES), "deg"),
        ("tip", _number(pooled(summary.tip)), study.unit),
    ]
    return errors[:2] if study.request.tip is None else errors


def _weakness_text(weakness: Weakness, unit: str, scale: float) -> str:
    kind = "turns about" if scale != 1 else "along"
    times = "" if math.isinf(weakness.ratio) else f", {weakness.ratio:.2g} times the best direction"
    return (
        f"{kind} {_vector(weakness.direction)}: {_number(weakness.deviation * scale)} {unit} at "
        f"pose {weakness.pose}{times}"
    )


def _alike_text(summary: Summary) -> str:
    symmetry = f"{summary.symmetries} orientations look the same"
    look_alikes = [
        f"another pose turned by {other.turn_deg:.0f} deg looks nearly the same, "
        f"{other.difference:.1f} deviations apart"
        for other in summary.alike[:_NOTED]
    ]
    return "; ".join([symmetry if summary.symmetries > 1 else "no symmetry", *look_alikes])


def _confirmation_text(result: Confirmation, plan: Plan) -> str:
    statuses = ", ".join(f"{n} {status}" for status, n in sorted(result.statuses.items()))
    free = np.flatnonzero(plan.free)
    ratios = ", ".join(f"{TWIST_NAMES[k]} {result.ratios[k]:.3f}" for k in free)
    poses = f"{result.poses} pose{'s' * (result.poses != 1)}"
    return (
        f"{result.frames} frames at {poses} ({statuses}): errors are {result.overall:.3f} "
        f"times the predicted (by chance 1 ± {result.chance:.3f}); {ratios}"
    )


def _comparison(study: Study) -> list[str]:
    systems = study.systems
    width = max(12, *(len(system.name) + 2 for system in systems))
    rows = [("", [system.name for system in systems])]
    for errors in zip(*(_errors(system.summary, study) for system in systems), strict=True):
        what, _, unit = errors[0]
        rows.append((f"{what}, {unit}", [error for _, error, _ in errors]))
    lines = [f"{title:<16}" + "".join(f"{cell:>{width}}" for cell in row) for title, row in rows]
    for system in systems[1:]:
        assert system.equal is not None, "all but the first are compared"
        lines.append(_equal_text(system, system.equal, systems[0].name, study.unit))
    return lines


def _equal_text(system: System, equal: Equal, first: str, unit: str) -> str:
    if equal.factor is None:
        return f"{system.name} cannot equal {first}, whatever its detections err by"
    text = (
        f"{system.name} equals {first} ({_number(equal.wanted)} {unit}) with "
        f"{_noise_text(system.plan, equal.noises, unit)}: {equal.factor:.3g} times its noise"
    )
    if equal.confirmation is not None:
        text += f"; simulated: {_number(equal.confirmation.found[2])} {unit}"
    return text


def _congruence_text(shared: LookAlike, unit: str) -> str:
    ours = ", ".join(shared.body.labels[i] for i in shared.features)
    theirs = ", ".join(shared.other.labels[j] for j in shared.partners)
    return (
        f"{len(shared.features)} markers of {shared.body.name} ({ours}) lie like those of "
        f"{shared.other.name} ({theirs}), to {_number(shared.off)} {unit}: one body may be taken "
        "for the other; move one of them"
    )


def _gain(error: float, before: float) -> str:
    return f"{1 - error / before:.0%}" if math.isfinite(before) else "what is not determined"


def _place(sensor: Sensor) -> str:
    if isinstance(sensor, RangeSensor):
        return f"at {_vector(sensor.position)}"
    T: Floats = sensor.T_sensor_world  # type: ignore[attr-defined]
    return f"at {_vector(inverse(T)[:3, 3])} that looks along {_vector(T[2, :3])}"


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "open"


def _vector(values: Floats) -> str:
    largest = float(np.abs(values).max())
    shown = [0.0 if abs(v) < 5e-3 * largest else float(f"{v:.3g}") for v in values]
    return f"({', '.join(f'{v:g}' for v in shown)})"


JSON_MARK = '"type": "design"'
"""The beginning of a study's JSON, by which mixpose knows its own files."""


def study_json(study: Study) -> dict[str, Any]:
    """Return a study as JSON; what is not determined is null."""
    document: dict[str, Any] = {
        "type": "design",
        "unit": study.unit,
        "tip": study.request.tip,
        "poses": study.request.poses,
        "systems": [_system_json(system) for system in study.systems],
        "congruent": [
            {
                "bodies": [alike.body.name, alike.other.name],
                "markers": list(zip(alike.features, alike.partners, strict=True)),
                "misfit": alike.off,
            }
            for alike in study.congruences
        ],
    }
    return {key: plain(value) for key, value in document.items()}


def _system_json(system: System) -> dict[str, Any]:
    summary, plan, move, new = system.summary, system.plan, system.move, system.new
    result: dict[str, Any] = {
        "name": system.name,
        "noise": _by_sensor(plan, plan.noises),
        "error": system.error,
        "error_if_weighed": system.weighed,
        **{key: getattr(summary, key) for key in ("deviations", "position", "rotation", "tip")},
        "seen": _by_sensor(plan, summary.seen),
        "of_sigma": _by_sensor(plan, summary.narrow),
        "crowded": _by_sensor(plan, summary.crowded),
        "undetermined": summary.undetermined,
        "symmetries": summary.symmetries,
        "alike": [
            {"turn_deg": other.turn_deg, "deviations_apart": other.difference}
            for other in summary.alike
        ],
        "weakest_position": summary.weakest_position and asdict(summary.weakest_position),
        "weakest_rotation": summary.weakest_rotation and asdict(summary.weakest_rotation),
    }
    result |= _simulated_json(system.confirmation)
    if (equal := system.equal) is not None:
        noise = {} if equal.factor is None else {"noise": _by_sensor(plan, equal.noises)}
        stated = {"factor": equal.factor, "error": equal.wanted, **noise}
        result["equals_first_with"] = stated | _simulated_json(equal.confirmation)
    if move is not None:
        marker = plan.body.labels[move.marker]
        result["move_marker"] = {"marker": marker, "shift": move.shift, "error": move.error}
    if new is not None:
        key = "position" if isinstance(new.sensor, RangeSensor) else "T_sensor_world"
        place = {key: getattr(new.sensor, key)}
        result["new_sensor"] = {"like": new.like, "error": new.error, **place}
    return result


def _by_sensor(plan: Plan, values: Iterable[float]) -> dict[str, float]:
    return dict(zip(plan.names, values, strict=True))


def _simulated_json(result: Confirmation | None) -> dict[str, Any]:
    if result is None:
        return {}
    document = asdict(result)
    for key in ("predicted", "found"):
        document[key] = dict(zip(("position", "rotation", "tip"), document[key], strict=True))
    return {"simulated": document}

"""An evaluation as a table for people and as a dict for programs."""

from __future__ import annotations

from typing import Any

from mixpose import rigid
from mixpose.poses.evaluate import Evaluation, Spread

_STATISTICS = ("rms", "median", "p95", "max")


def as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """The evaluation as plain values for JSON; what could not be measured is None.

    ``per_axis`` holds the RMS along (x, y, z, in ``unit``) and about (rx, ry, rz, in degrees)
    the world's axes; ``ok_frames`` the errors of frames that are ok alone; ``best_hypothesis``
    those of the best hypothesis of ambiguous frames.
    """
    nees = evaluation.nees
    per_axis = evaluation.per_axis_rms
    has_hypotheses = evaluation.best_rotation_deg is not None
    return {
        "unit": evaluation.unit,
        "frames": evaluation.frames,
        "ok": evaluation.ok,
        "ambiguous": evaluation.ambiguous,
        "lost": evaluation.lost,
        "missing": evaluation.missing,
        "without_truth": evaluation.without_truth,
        "rotation_deg": _spread_dict(evaluation.rotation_deg),
        "translation": _length_dict(evaluation.translation, evaluation.unit),
        "per_axis": None if per_axis is None else dict(per_axis),
        "ok_frames": None
        if evaluation.ok_rotation_deg is None
        else {
            "rotation_deg": _spread_dict(evaluation.ok_rotation_deg),
            "translation": _length_dict(evaluation.ok_translation, evaluation.unit),
        },
        "best_hypothesis": {
            "frames": evaluation.ambiguous,
            "rotation_deg": _spread_dict(evaluation.best_rotation_deg),
            "translation": _length_dict(evaluation.best_translation, evaluation.unit),
        }
        if has_hypotheses
        else None,
        "nees": None
        if nees is None
        else {
            "frames": nees.frames,
            "mean_per_dimension": nees.nees_per_dimension,
            "inside_95": nees.inside_95,
        },
    }


def as_table(evaluation: Evaluation) -> str:
    """The evaluation as aligned plain text, several lines without a final newline."""
    unit = evaluation.unit or "units"
    lines = [
        f"{evaluation.frames} frame{'s' * (evaluation.frames != 1)}: {evaluation.ok} ok, "
        f"{evaluation.ambiguous} ambiguous, {evaluation.lost} lost, {evaluation.missing} missing"
    ]
    if evaluation.without_truth:
        many = evaluation.without_truth != 1
        lines.append(
            f"{evaluation.without_truth} pose line{'s have' if many else ' has'} no truth and "
            f"{'do' if many else 'does'} not count"
        )
    lines += ["", *_spread_lines(evaluation, unit), *_axis_lines(evaluation, unit)]
    if evaluation.best_rotation_deg is not None:
        lines += [
            "",
            f"rotation and position count the ambiguous frame{'s' * (evaluation.ambiguous != 1)}, "
            "too; ok alone: without these; best hypothesis: of each of these, the pose nearest to "
            "the truth",
        ]
    nees = evaluation.nees
    if nees is None:
        lines += ["", "covariance: no frame that is ok has one"]
    else:
        counted = f"{nees.frames} frame{'s that are' if nees.frames != 1 else ' that is'} ok"
        lines += [
            "",
            f"covariance, {counted}: "
            f"squared error per dimension {nees.nees_per_dimension:.3g} (right: 1), "
            f"inside the 95 % ellipsoid {100 * nees.inside_95:.3g} %",
        ]
    return "\n".join(lines)


def _spread_lines(evaluation: Evaluation, unit: str) -> list[str]:
    if evaluation.rotation_deg is None or evaluation.translation is None:
        return ["no frame has a pose to compare"]
    rows = [
        ("rotation, deg", evaluation.rotation_deg),
        (f"position, {unit}", evaluation.translation),
    ]
    if evaluation.best_rotation_deg is not None and evaluation.best_translation is not None:
        if evaluation.ok_rotation_deg is not None and evaluation.ok_translation is not None:
            rows += [
                ("ok alone, deg", evaluation.ok_rotation_deg),
                (f"ok alone, {unit}", evaluation.ok_translation),
            ]
        rows += [
            ("best hypothesis, deg", evaluation.best_rotation_deg),
            (f"best hypothesis, {unit}", evaluation.best_translation),
        ]
    lines = [_row("error", [*_STATISTICS, "in frame"])]
    for name, spread in rows:
        figures = [f"{getattr(spread, statistic):.4g}" for statistic in _STATISTICS]
        lines.append(_row(name, [*figures, str(spread.worst_frame)]))
    return lines


def _axis_lines(evaluation: Evaluation, unit: str) -> list[str]:
    rms = evaluation.per_axis_rms
    if rms is None:
        return []
    along, about = rigid.TWIST_NAMES[:3], rigid.TWIST_NAMES[3:]
    return [
        "",
        _row("RMS by world axis", ["x", "y", "z"]),
        _row("about it, deg", [f"{rms[name]:.4g}" for name in about]),
        _row(f"along it, {unit}", [f"{rms[name]:.4g}" for name in along]),
    ]


def _row(name: str, cells: list[str]) -> str:
    return name.ljust(24) + "".join(cell.rjust(11) for cell in cells)


def _spread_dict(spread: Spread | None) -> dict[str, Any] | None:
    if spread is None:
        return None
    return {
        "rms": spread.rms,
        "median": spread.median,
        "p95": spread.p95,
        "max": spread.max,
        "worst_frame": spread.worst_frame,
    }


def _length_dict(spread: Spread | None, unit: str | None) -> dict[str, Any] | None:
    values = _spread_dict(spread)
    return None if values is None else {**values, "unit": unit}

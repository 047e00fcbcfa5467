"""Report an evaluation as a table for people and as a dict for programs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from mixpose import rigid
from mixpose.poses.evaluate import Evaluation, Spread

_COUNTED = (
    "unit",
    "frames",
    "ok",
    "ambiguous",
    "lost",
    "missing",
    "without_truth",
    "ok_without_truth",
)
_STATISTICS = ("rms", "median", "p95", "max")


def as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return the evaluation as plain values for JSON; None for what could not be measured.

    ``per_axis`` is the RMS along (x, y, z, in ``unit``) and about (rx, ry, rz, in degrees) the
    world's axes; ``best_hypothesis`` the errors of the best hypothesis of ambiguous frames.
    """
    nees, per_axis = evaluation.nees, evaluation.per_axis_rms
    best = {"frames": evaluation.ambiguous, **_errors(evaluation, "best_")}
    return {
        **{key: getattr(evaluation, key) for key in _COUNTED},
        **_errors(evaluation),
        "per_axis": None if per_axis is None else dict(per_axis),
        "ok_frames": _errors(evaluation, "ok_") if evaluation.ok_rotation_deg else None,
        "best_hypothesis": best if evaluation.best_rotation_deg else None,
        "nees": None if nees is None else asdict(nees),
        **_rare_entries(evaluation),
    }


def _rare_entries(evaluation: Evaluation) -> dict[str, Any]:
    """Return the entries that only several bodies, or odd findings, have."""
    offset, swaps = evaluation.offset, evaluation.swaps
    values = {
        "constant_offset": offset and asdict(offset) | {"T": offset.T.tolist()},
        "exchanged": evaluation.exchanged,
        "bodies": {label: as_dict(body) for label, body in evaluation.bodies.items()},
        "swaps": swaps and asdict(swaps),
    }
    return {key: value for key, value in values.items() if value}


def as_table(evaluation: Evaluation) -> str:
    """Return the evaluation as aligned plain text, without a final newline."""
    if not evaluation.bodies:
        return "\n".join([*_one_body(evaluation), *_swap_lines(evaluation)])
    parts = [
        f"{name}: " + "\n".join(_one_body(body)) + "\n" for name, body in evaluation.bodies.items()
    ]
    everything = [f"all bodies: {_counts(evaluation, 'poses')}", *_swap_lines(evaluation)]
    return "\n".join([*parts, *everything])


def _counts(evaluation: Evaluation, word: str) -> str:
    word = word if evaluation.frames != 1 else word.removesuffix("s")
    return (
        f"{evaluation.frames} {word}: {evaluation.ok} ok, {evaluation.ambiguous} ambiguous, "
        f"{evaluation.lost} lost, {evaluation.missing} missing"
    )


def _swap_lines(evaluation: Evaluation) -> list[str]:
    swaps = evaluation.swaps
    if swaps is None:
        return []
    return [
        f"identical bodies: {swaps.count} swap{'s' * (swaps.count != 1)}, {swaps.announced} of "
        "them announced (not ok before or where it happened)"
    ]


def _one_body(evaluation: Evaluation) -> list[str]:
    unit = evaluation.unit or "units"
    lines = [_counts(evaluation, "frames")]
    if evaluation.without_truth:
        many, ok = evaluation.without_truth != 1, evaluation.ok_without_truth
        of_nothing = f"; {ok} of them ok: wrong, if the body was away" if ok else ""
        lines.append(
            f"{evaluation.without_truth} pose line{'s have' if many else ' has'} no truth and "
            f"{'do' if many else 'does'} not count{of_nothing}"
        )
    lines += ["", *_spread_lines(evaluation, unit), *_axis_lines(evaluation, unit)]
    remarks = []
    if evaluation.best_rotation_deg is not None:
        remarks.append(
            f"rotation and position count the ambiguous frame{'s' * (evaluation.ambiguous != 1)}, "
            "too; ok alone: without these; best hypothesis: of each of these, the pose nearest to "
            "the truth"
        )
    nees = evaluation.nees
    if nees is None:
        remarks.append("covariance: no frame that is ok has one")
    else:
        counted = f"{nees.frames} frame{'s that are' if nees.frames != 1 else ' that is'} ok"
        remarks.append(
            f"covariance, {counted}: squared error per dimension {nees.mean_per_dimension:.3g} "
            f"(right: 1), inside the 95 % ellipsoid {100 * nees.inside_95:.3g} %"
        )
    if evaluation.offset is not None:
        remarks.append(evaluation.offset.text(unit))
    if evaluation.exchanged:
        remarks.append(
            "the truth has covariances, as estimates do, and the poses have none: were the two "
            "files exchanged? mixpose evaluate POSES.jsonl TRUTH.jsonl"
        )
    return [*lines, *(line for remark in remarks for line in ("", remark))]


def _spread_lines(evaluation: Evaluation, unit: str) -> list[str]:
    if evaluation.rotation_deg is None or evaluation.translation is None:
        return ["no frame has a pose to compare"]
    rows: dict[str, Spread | None] = {
        "rotation, deg": evaluation.rotation_deg,
        f"position, {unit}": evaluation.translation,
    }
    if evaluation.best_rotation_deg is not None:
        rows |= {
            "ok alone, deg": evaluation.ok_rotation_deg,
            f"ok alone, {unit}": evaluation.ok_translation,
            "best hypothesis, deg": evaluation.best_rotation_deg,
            f"best hypothesis, {unit}": evaluation.best_translation,
        }
    lines = [_row("error", [*_STATISTICS, "in frame"])]
    for name, spread in rows.items():
        if spread is not None:
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


def _errors(evaluation: Evaluation, prefix: str = "") -> dict[str, Any]:
    turn, shift = (getattr(evaluation, f"{prefix}{key}") for key in ("rotation_deg", "translation"))
    unit = {"unit": evaluation.unit}
    return {
        "rotation_deg": None if turn is None else asdict(turn),
        "translation": None if shift is None else asdict(shift) | unit,
    }

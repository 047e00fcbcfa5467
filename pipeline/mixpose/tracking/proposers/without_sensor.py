"""A sensor that disagrees with the others: out of step, or bumped.

Where two sensors or more agree on most of the body, the pose is fitted to them alone; what is left
out counts as missed in the evidence.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scipy.special import fdtri

from mixpose.judgement import AcceptanceRules, Association, Judged, NoiseModel
from mixpose.tracking.likelihood import FrameData, Likelihood, Start

OUT_OF_STEP = "out of step or bumped"


def without_sensor(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """The pose fitted without the sensors that disagree with two others or more."""
    if not likelihood.knows_detections or len(data.views) < 3:
        return
    if any(not report.used for report in judged.sensors.values()):
        return  # some are left out already
    rules = data.rules
    if apart := disagreeing(judged.associations, rules.acceptance, rules.judgement.noise):
        yield Start(judged.T_world_object, data.close, left_out=dict.fromkeys(apart, OUT_OF_STEP))


def disagreeing(
    associations: Sequence[Association], rules: AcceptanceRules, model: NoiseModel
) -> list[str]:
    """Sensors that see the body elsewhere than two others or more do.

    One that meets little of it, with as many detections beside it that belong to nothing; or one
    whose residuals are far larger than the others', more than chance would make them.
    """
    agreeing = [one for one in associations if one.coverage >= rules.agreeing]
    apart = [
        one.name
        for one in associations
        if one.coverage < rules.agreeing
        and one.expected > 0
        and one.surplus >= rules.agreeing * one.missed
    ]
    for one in agreeing:
        others = [other for other in agreeing if other is not one]
        degrees = sum(other.measurements for other in others)
        if len(others) < 2 or degrees == 0:
            continue
        variance = sum(other.squares for other in others) / degrees
        own = one.squares / one.measurements
        limit = max(rules.disagreeing, float(fdtri(one.measurements, degrees, model.by_chance)))
        if own > limit * max(variance, model.smallest**2):
            apart.append(one.name)
    left = [one for one in agreeing if one.name not in apart]
    return apart if len(left) >= 2 else []

"""Which detection is which feature, and where features are in space by their detections alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import Observation
from mixpose.records import Estimate, Floats, Label, MeasuredPoint, Offsets
from mixpose.rigid import transform


@dataclass(frozen=True)
class LabelRules:
    """When detections of a feature put it in space."""

    least_sine: float = constant(
        0.035, "of the angle between two rays: at 2° a depth errs by 29 times what is across"
    )

    def fix(self, J: Floats) -> bool:
        """Whether rows (K, 3), in deviations by length, fix a point in all directions."""
        values = np.linalg.svd(J, compute_uv=False)
        # two equal rays at a small angle a have singular values of which the ratio is a/2
        return len(values) == 3 and bool(values[2] >= self.least_sine / 2 * values[0])


def labelled(
    estimate: Estimate,
    seen: Mapping[str, Observation],
    body: Body,
    rules: LabelRules = LabelRules(),
) -> Estimate:
    """An estimate with the labels of its detections, and the points in space that they measure.

    Parameters
    ----------
    estimate : Estimate
        Of a frame, as a tracker gives it.
    seen : mapping of str to Observation
        All that the sensors saw in that frame.
    body : Body
        Of one point per feature; of others nothing is labelled.
    rules : LabelRules

    Returns
    -------
    Estimate
        With `SensorReport.labels` and `points`.  A detection that two features share puts neither
        of them in space.
    """
    offsets, T = estimate.offsets, estimate.T_world_object
    if T is None or not offsets:
        return estimate
    reports = {
        name: replace(report, labels=_labels(offsets[name], seen[name], body))
        if name in offsets
        else report
        for name, report in estimate.sensors.items()
    }
    sigmas = {name: one.sigma for name, one in seen.items()}
    places = transform(T, body.means)
    points = {}
    for i, (label, place) in enumerate(zip(body.labels, places, strict=True)):
        measured = _measured(offsets, sigmas, i, rules)
        if measured is not None:
            points[label] = MeasuredPoint(place + measured[0], measured[1])
    return replace(estimate, sensors=reports, points=points)


def _labels(own: Offsets, seen: Observation, body: Body) -> dict[str, Label]:
    """What one sensor met each feature by, exactly as it detected it."""
    detections, labels = seen.points, {}
    for i, at in zip(own.features[own.met].tolist(), own.observed[own.met], strict=True):
        if detections is None:
            labels[body.labels[i]] = Label(at)
        else:
            # what another body has was left out where it was numbered
            nearest = int(np.square(detections - at).sum(axis=1).argmin())
            labels[body.labels[i]] = Label(detections[nearest], nearest)
    return labels


def _measured(
    offsets: Mapping[str, Offsets], sigmas: Mapping[str, float], i: int, rules: LabelRules
) -> tuple[Floats, float] | None:
    """How far (3,) a feature is from where the pose has it, and its residual; None: not fixed.

    One step of least squares from the pose, as of the moments at which each sensor saw it: offsets
    are so small beside distances that it is the last.
    """
    rows = [
        (one.by_shift[k] / sigmas[name], one.offsets[k] / sigmas[name])
        for name, one in offsets.items()
        for k in np.flatnonzero((one.features == i) & one.met & ~one.shared).tolist()
    ]
    if not rows:
        return None
    J = np.concatenate([by_shift for by_shift, _ in rows])
    if not rules.fix(J):
        return None
    shift = np.linalg.lstsq(J, np.concatenate([off for _, off in rows]))[0]
    apart = [np.linalg.pinv(by_shift) @ (off - by_shift @ shift) for by_shift, off in rows]
    return shift, float(np.sqrt(np.square(apart).sum(axis=1).mean()))

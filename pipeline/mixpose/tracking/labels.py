"""Label detections with the features they show, and measure features in space by them alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.density import Observation
from mixpose.records import Estimate, Floats, Label, MeasuredPoint, Offsets, replace
from mixpose.rigid import transform


@dataclass(frozen=True)
class LabelRules:
    """When the detections of a feature measure its place in space."""

    least_sine: float = constant(
        0.035, "of the angle between two rays: at 2° a depth errs by 29 times what is across"
    )

    def fix(self, J: Floats) -> bool:
        """Test whether rows (K, 3), in standard deviations per length, fix a point in space."""
        values = np.linalg.svd(J, compute_uv=False)
        # two equal rays at a small angle a have a ratio of singular values of a/2
        return len(values) == 3 and bool(values[2] >= self.least_sine / 2 * values[0])


def labelled(
    estimate: Estimate,
    seen: Mapping[str, Observation],
    body: Body,
    rules: LabelRules = LabelRules(),
) -> Estimate:
    """Return an estimate with labels of its detections, and the points in space that they measure.

    Parameters
    ----------
    estimate : Estimate
        Of a frame, from a tracker.
    seen : mapping of str to Observation
        All observations of the sensors in that frame.
    body : Body
        With one point per feature; other bodies get no labels.
    rules : LabelRules

    Returns
    -------
    Estimate
        With `SensorReport.labels` and `points`; detections shared by two features measure none.
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
    sigmas = {name: observation.sigma for name, observation in seen.items()}
    places = transform(T, body.means)
    points = {}
    for i, (label, place) in enumerate(zip(body.labels, places, strict=True)):
        measured = _measured(offsets, sigmas, i, rules)
        if measured is not None:
            points[label] = MeasuredPoint(place + measured[0], measured[1])
    return replace(estimate, sensors=reports, points=points)


def _labels(offsets: Offsets, seen: Observation, body: Body) -> dict[str, Label]:
    """Return the detections that one sensor met features by, exactly as it detected them."""
    detections, labels = seen.points, {}
    met = offsets.met
    for i, at in zip(offsets.features[met].tolist(), offsets.observed[met], strict=True):
        if detections is None:
            labels[body.labels[i]] = Label(at)
        else:
            # numbers of the frame left out detections of other bodies
            nearest = int(np.square(detections - at).sum(axis=1).argmin())
            labels[body.labels[i]] = Label(detections[nearest], nearest)
    return labels


def _measured(
    offsets: Mapping[str, Offsets], sigmas: Mapping[str, float], i: int, rules: LabelRules
) -> tuple[Floats, float] | None:
    """Return the offset (3,) of a feature from the pose, and its residual; None if it is not fixed.

    One least-squares step from the pose, as of the moments at which each sensor saw the feature:
    offsets are so small beside distances that no second one is needed.
    """
    rows = [
        (seen.by_shift[k] / sigmas[name], seen.offsets[k] / sigmas[name])
        for name, seen in offsets.items()
        for k in np.flatnonzero((seen.features == i) & seen.met & ~seen.shared).tolist()
    ]
    if not rows:
        return None
    J = np.concatenate([by_shift for by_shift, _ in rows])
    if not rules.fix(J):
        return None
    shift = np.linalg.lstsq(J, np.concatenate([off for _, off in rows]))[0]
    residuals = [np.linalg.pinv(by_shift) @ (off - by_shift @ shift) for by_shift, off in rows]
    return shift, float(np.sqrt(np.square(residuals).sum(axis=1).mean()))

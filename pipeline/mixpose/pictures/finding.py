"""What one sensor found in a frame, against what a pose expects there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose.body import Body
from mixpose.judgement import JudgementRules
from mixpose.matching import associate
from mixpose.objective import View, matched_objective
from mixpose.pictures.overlay import projected_features
from mixpose.records import Estimate, Floats, Mask, PointPattern, RawFrame
from mixpose.rigid import transform
from mixpose.session import SensorSetup


@dataclass(frozen=True)
class Expectation:
    """What a pose expects of one sensor, and how far that is met."""

    y: Floats  # (N, m), where the features are expected
    seen: Mask  # (N,), which of them are in view and face the sensor
    met: Mask  # (N,), which of those were found there
    unexplained: Mask  # (M,), which of the found points (if points they are) belong to no feature
    explained: float  # share of the sensor's density that the pose accounts for
    rms: float | None  # residual of the met features, sensor units
    sure: bool  # whether it is "ok": what its features meet are markers then, and not clutter


@dataclass(frozen=True)
class Finding:
    """One sensor's frame, the features found in it, and what a pose expects."""

    setup: SensorSetup
    frame: RawFrame | None  # None where the sensor has no frame of this number
    view: View | None  # None where it has no frame
    points: Floats | None  # (M, m), where the extraction gives points
    # points found, with those passed over, or points of light with the energy of a grid
    count: float
    expectation: Expectation | None  # None without a pose or without features

    @property
    def name(self) -> str:
        """Of the sensor."""
        return self.setup.name

    @property
    def sigma(self) -> float:
        """Finest standard deviation of a feature, sensor units."""
        return self.setup.extract.sigma if self.view is None else self.view.observation.sigma

    @property
    def passed_over(self) -> int:
        """Points found that are not among `points`, as they were too many."""
        return 0 if self.view is None else self.view.observation.passed_over


def find(
    setups: Sequence[SensorSetup],
    frames: Mapping[str, RawFrame],
    views: Sequence[View],
    body: Body,
    estimate: Estimate,
) -> list[Finding]:
    """Compare what every sensor found with what the estimate expects of it."""
    by_name = {view.name: view for view in views}
    T, sure = estimate.T_world_object, estimate.status == "ok"
    found = []
    for setup in setups:
        frame, view = frames.get(setup.name), by_name.get(setup.name)
        if view is None:
            found.append(Finding(setup, frame, None, None, 0.0, None))
            continue
        pattern, sigma = view.observation.pattern, view.observation.sigma
        if isinstance(pattern, PointPattern):
            points, count = pattern.points, float(view.observation.found)
        else:  # so many equal features would have the energy of the grid
            top = (4 * np.pi * sigma**2) ** (-view.sensor.dimension / 2)
            energy = view.observation.energy(sigma)
            points, count = None, float(top / energy) if energy > 0 else 0.0
        expectation = None if T is None else _expect(view, body, T, points, sure=sure)
        found.append(Finding(setup, frame, view, points, count, expectation))
    return found


def find_several(
    setups: Sequence[SensorSetup],
    frames: Mapping[str, RawFrame],
    views: Sequence[View],
    bodies: Sequence[Body],
    estimates: Sequence[Estimate],
) -> list[list[Finding]]:
    """The same for each of several bodies, on what the poses of the others leave unexplained."""
    pairs = list(zip(bodies, estimates, strict=True))
    alone = [find(setups, frames, views, body, one) for body, one in pairs]
    if len(pairs) == 1:
        return alone
    found = []
    for k, (body, one) in enumerate(pairs):
        others = [finding for each in (*alone[:k], *alone[k + 1 :]) for finding in each]
        left = [_unexplained(view, others) for view in views]
        found.append(find(setups, frames, left, body, one))
    return found


def _unexplained(view: View, others: Sequence[Finding]) -> View:
    """What poses of other bodies leave of a view of detections."""
    pattern = view.observation.pattern
    if not isinstance(pattern, PointPattern):
        return view
    left = np.ones(len(pattern.points), dtype=np.bool_)
    for finding in others:
        if finding.name == view.name and finding.expectation is not None:
            left &= finding.expectation.unexplained
    return replace(view, observation=view.observation.only(left))


def _expect(view: View, body: Body, T: Floats, points: Floats | None, *, sure: bool) -> Expectation:
    y, _, seen = projected_features(view.sensor, body, T)
    nodes, in_view = view.sensor.project(transform(T, body.nodes.points))
    met, explained, rms, rules = np.zeros_like(seen), 0.0, None, JudgementRules()
    if not view.observation.is_empty:
        objective = matched_objective([view], body, [view.observation.sigma])
        found = associate(objective, T, rules.association, rules.noise.errors.narrowest)
        if found.weights.any():
            shares = np.bincount(body.nodes.feature, found.shares[0], minlength=len(body))
            full = np.bincount(body.nodes.feature, body.nodes.weights, minlength=len(body))
            met = seen & (shares > rules.association.min_share * full)
            in_view &= found.weights[0] > 0
            explained, rms = float(found.explained[0]), found.rms[0]
    unexplained = np.zeros(0, dtype=np.bool_)
    if points is not None:
        away = np.linalg.norm(points[:, None] - nodes[in_view], axis=-1)
        reach = view.observation.sigma * np.sqrt(2 * rules.association.reach_squared)
        unexplained = away.min(axis=1, initial=np.inf) > reach
    return Expectation(y, seen, met, unexplained, explained, rms, sure)

"""Compare the detections of a sensor in a frame with the expectation of a pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    """Features that a pose expects in one sensor, and how well these are met."""

    y: Floats  # (N, m) expected places of the features
    seen: Mask  # (N,) features in view that face the sensor
    met: Mask  # (N,) those of them that are met
    unexplained: Mask  # (M,) detections, if there are points, that belong to no feature
    explained: float  # share of the sensor's density that the pose explains
    rms: float | None  # residual of the met features, in units of the sensor
    is_sure: bool  # whether the pose is "ok", so that met detections are markers and not clutter


@dataclass(frozen=True)
class Finding:
    """A sensor's frame, its detections, and the expectation of a pose."""

    setup: SensorSetup
    frame: RawFrame | None  # None if the sensor has no frame of this number
    view: View | None  # None without a frame
    points: Floats | None  # (M, m) detections, if the extraction gives points
    count: float  # of detections, with those passed over, or of points with the grid's energy
    expectation: Expectation | None  # None without a pose or without features

    @property
    def name(self) -> str:
        """Name of the sensor."""
        return self.setup.name

    @property
    def sigma(self) -> float:
        """Finest standard deviation σ_ε of a feature, in units of the sensor."""
        return self.setup.extract.sigma if self.view is None else self.view.observation.sigma

    @property
    def passed_over(self) -> int:
        """Number of detections that were discarded as too many."""
        return 0 if self.view is None else self.view.observation.passed_over


def find(
    setups: Sequence[SensorSetup],
    frames: Mapping[str, RawFrame],
    views: Sequence[View],
    body: Body,
    estimate: Estimate,
) -> list[Finding]:
    """Compare the detections of all sensors with the expectation of an estimate."""
    by_name = {view.name: view for view in views}
    T, is_sure = estimate.T_world_object, estimate.status == "ok"
    findings = []
    for setup in setups:
        frame, view = frames.get(setup.name), by_name.get(setup.name)
        if view is None:
            findings.append(Finding(setup, frame, None, None, 0.0, None))
            continue
        pattern, sigma = view.observation.pattern, view.observation.sigma
        if isinstance(pattern, PointPattern):
            points, count = pattern.points, float(view.observation.found)
        else:  # number of equal features with the energy of the grid
            top = (4 * np.pi * sigma**2) ** (-view.sensor.dimension / 2)
            energy = view.observation.energy(sigma)
            points, count = None, float(top / energy) if energy > 0 else 0.0
        expectation = None if T is None else _expect(view, body, T, points, sure=is_sure)
        findings.append(Finding(setup, frame, view, points, count, expectation))
    return findings


def find_several(
    setups: Sequence[SensorSetup],
    frames: Mapping[str, RawFrame],
    views: Sequence[View],
    bodies: Sequence[Body],
    estimates: Sequence[Estimate],
) -> list[list[Finding]]:
    """Compare, per body, the detections that other bodies leave unexplained with its estimate."""
    pairs = list(zip(bodies, estimates, strict=True))
    alone = [find(setups, frames, views, *pair) for pair in pairs]
    if len(pairs) == 1:
        return alone
    findings = []
    for k, pair in enumerate(pairs):
        others = [finding for by_sensor in (*alone[:k], *alone[k + 1 :]) for finding in by_sensor]
        unclaimed = [_unclaimed_view(view, others) for view in views]
        findings.append(find(setups, frames, unclaimed, *pair))
    return findings


def _unclaimed_view(view: View, others: Sequence[Finding]) -> View:
    """Keep the detections of a view that belong to no feature of other bodies."""
    pattern = view.observation.pattern
    if not isinstance(pattern, PointPattern):
        return view
    unclaimed = np.ones(len(pattern.points), dtype=np.bool_)
    for finding in others:
        if finding.name == view.name and finding.expectation is not None:
            unclaimed &= finding.expectation.unexplained
    return view.only(unclaimed)


def _expect(view: View, body: Body, T: Floats, points: Floats | None, *, sure: bool) -> Expectation:
    """Compare a view, and its detections if it has points, with the projection of a pose."""
    y, _, seen = projected_features(view.sensor, body, T)
    nodes, in_view = view.sensor.project(transform(T, body.nodes.points))
    met, explained, rms, rules = np.zeros_like(seen), 0.0, None, JudgementRules()
    if not view.observation.is_empty:
        objective = matched_objective([view], body, [view.observation.sigma])
        matches = associate(objective, T, rules.association, rules.noise.errors.narrowest)
        if matches.weights.any():
            shares = np.bincount(body.nodes.feature, matches.shares[0], minlength=len(body))
            full = np.bincount(body.nodes.feature, body.nodes.weights, minlength=len(body))
            met = seen & (shares > rules.association.min_share * full)
            in_view &= matches.weights[0] > 0
            explained, rms = float(matches.explained[0]), matches.rms[0]
    unexplained = np.zeros(0, dtype=np.bool_)
    if points is not None:
        away = np.linalg.norm(points[:, None] - nodes[in_view], axis=-1)
        reach = view.observation.sigma * np.sqrt(2 * rules.association.reach_squared)
        unexplained = away.min(axis=1, initial=np.inf) > reach
    return Expectation(y, seen, met, unexplained, explained, rms, sure)

"""What a search is given, the guesses that it may make, and its results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.judgement import JudgementRules
from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.search.budget import THOROUGH, SearchBudget
from mixpose.search.detections import SensorDetections
from mixpose.sensors import Rays


@dataclass(frozen=True, eq=False)
class SearchProblem:
    """What stays the same during a search."""

    detections: Sequence[SensorDetections]
    body: Body
    free: NDArray[np.bool_]  # (6,) which directions may differ from the reference
    T_reference: Floats  # (4, 4), looked at only where a direction is not free
    rules: JudgementRules = JudgementRules()
    budget: SearchBudget = THOROUGH
    seed: int = 0  # of the order in which guesses are tried, where not all can be

    @cached_property
    def cameras(self) -> list[tuple[SensorDetections, Rays]]:
        """Sensors whose detections have lines of sight, with these."""
        return [
            (sensor, sensor.rays)
            for sensor in self.detections
            if sensor.rays is not None and len(sensor.rays)
        ]

    @property
    def gate(self) -> float:
        """Largest error of a detection in σ_ε."""
        return self.rules.noise.errors.met

    def reach(self, sensor: SensorDetections) -> float:
        """Largest error of a sensor's detections, in its units."""
        return self.gate * sensor.sigma

    def allowed(self, poses: Floats) -> Floats:
        """The poses nearest to poses (H, 4, 4) whose held directions are the reference's."""
        if self.free.all() or not len(poses):
            return poses
        shifts, turns = self.free[:3], self.free[3:]
        R_reference, t_reference = self.T_reference[:3, :3], self.T_reference[:3, 3]
        R, t = poses[:, :3, :3], np.where(shifts, poses[:, :3, 3], t_reference)
        if not turns.all():
            turned = Rotation.from_matrix(R @ R_reference.T)
            if turns.sum() == 1:  # of swing and twist the twist alone
                x, y, z, w = turned.as_quat().T
                vectors = np.where(turns, 2 * np.arctan2(np.array([x, y, z]), w).T, 0.0)
            else:
                vectors = np.where(turns, turned.as_rotvec(), 0.0)
            R = Rotation.from_rotvec(vectors).as_matrix() @ R_reference
        return from_parts(R, t)


class Generator(NamedTuple):
    """A way to make guesses: what is drawn, batch by batch, and the poses (K, 4, 4) of a batch."""

    name: str
    batches: Iterable[Any]
    poses: Callable[[Any], Floats]


class Candidate(NamedTuple):
    """A pose (4, 4) that may explain the views.

    Candidates are ranked by `evidence`: logarithm of the odds that this is not chance; with ranges
    among the sensors, the matched objective at the finest blur, summed over views, every detection
    counting alike.
    """

    T_world_object: Floats
    evidence: float


class SearchReport(NamedTuple):
    """What a search cost: guesses made, tested on all features and sensors, and refined."""

    made: int = 0
    tested: int = 0
    refined: int = 0


class SearchState(NamedTuple):
    """Where a search with a limited budget goes on in the next frame.

    `generator` of guesses, after the first, which is tried in every frame, and batches of it tried.
    """

    generator: int = 0
    batch: int = 0


class SearchResult(NamedTuple):
    """Candidates, best first, what they cost, and where to go on while none convinces."""

    candidates: list[Candidate]
    report: SearchReport = SearchReport()
    state: SearchState = SearchState()

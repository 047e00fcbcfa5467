"""The result of a calibration, its residuals, and which sensors were bumped.

A new calibration from the recording shows how far each sensor is off, relative to the others, and
how sure that is.  A motion of all sensors together does not matter: each sensor is compared with
the consensus of all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body.symmetry import motions
from mixpose.calibration.adjust import MET, Adjusted, deviations_of
from mixpose.calibration.profile import Contradiction
from mixpose.calibration.rig import Block, Rig, centre_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import SeenFrame, Task
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import from_parts, inverse
from mixpose.sensors import CalibrationError

HELD_LENS = CalibrationError(focal=1e-3, principal_point=1.0)
"""Usual error of a lens that was calibrated by itself."""


@dataclass(frozen=True)
class Residual:
    """Root mean square residuals of a sensor, in its units; NaN without any."""

    before: float  # with the calibration of the session
    after: float
    held: float  # of frames held back, with the calibration from the others: that of new data


@dataclass(frozen=True, eq=False)
class MetDetections:
    """Detections of a sensor that features met, for pictures and lists."""

    y: Floats  # (n, m): places of the detections
    offset: Floats  # (n, m): detected minus predicted, after the calibration
    frame: Indices  # (n,): frame numbers
    feature: Indices  # (n,)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration, its covariance, and the evidence for or against it."""

    before: Rig
    after: Rig
    blocks: tuple[Block, ...]
    deviations: Floats  # (G,): of the free parameters; infinite where not determined
    covariance: Floats  # (G, G)
    refused: tuple[str, ...]  # directions that the data do not determine; they stay as they were
    gauge: tuple[str, ...]  # freedoms of the rig that were removed
    through: Mapping[int, tuple[int | None, int]]  # as of `Start`
    unlinked: tuple[int, ...]
    used: tuple[int, ...]  # numbers of the frames that were used
    bad: tuple[int, ...]  # numbers of the frames that were left out as bad
    recorded: int  # frames of the recording with detections
    residuals: Mapping[int, Residual]
    noise: Floats  # (L,)
    inflation: float
    certainty: float  # as of `Adjusted`: near 1, unless features cannot be told apart
    # (G, G): covariances by held parameters whose errors are not stated: biases of ranges as large
    # as σ_ε, and lenses that are off by `HELD_LENS`
    of_biases: Floats
    of_lenses: Floats
    explained: Floats  # (L,): share of detections met, as of `explained_share`
    met: Mapping[int, MetDetections]  # by sensor
    poses: Mapping[int, Floats]  # (4, 4), by frame number
    contradicted: Contradiction | None = None  # held parameters that the recording contradicts
    T_new_old: Floats | None = None  # (4, 4): to the world of `after`, if it was changed

    @property
    def are_linked(self) -> bool:
        """Test whether shared frames link all sensors."""
        groups = list[set[int]]()  # frames of linked sensors
        for met in self.met.values():
            frames = set(met.frame.tolist())
            shared = [group for group in groups if group & frames]
            groups = [group for group in groups if not group & frames] + [frames.union(*shared)]
        return len(groups) == 1

    def linear(self, by_old: Floats) -> Calibration:
        """Return the calibration of parameters that are linear (G, G) in those of this one."""
        covariances = (self.covariance, self.of_biases, self.of_lenses)
        covariance, of_biases, of_lenses = (by_old @ C @ by_old.T for C in covariances)
        is_known = np.isfinite(self.deviations)
        return replace(
            self,
            covariance=covariance,
            deviations=np.where(is_known, deviations_of(covariance), np.inf),
            of_biases=of_biases,
            of_lenses=of_lenses,
        )

    def doubtful(self, rules: CalibrationRules) -> tuple[int, ...]:
        """Return sensors that probably stand elsewhere, as their detections are not explained."""
        return tuple(int(s) for s in np.flatnonzero(self.explained < rules.explained))


def rms(squared: Sequence[Floats]) -> float:
    """Return the root mean square of all values but NaN; NaN of none."""
    flat = np.concatenate([np.zeros(0), *squared])
    known = np.isfinite(flat)
    return float(np.sqrt(flat[known].mean())) if known.any() else float("nan")


def _matchable_counts(frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Count detections (K, L) by frame and sensor, up to the number of features."""
    features, sensors = len(task.rig.points), range(len(task.rig.sensors))
    return np.array([[min(len(f.points.get(s, ())), features) for s in sensors] for f in frames])


def _met_counts(adjusted: Adjusted, frames: Sequence[SeenFrame]) -> Floats:
    """Count met detections (K, L) by frame and sensor."""
    rows = [np.bincount(r.pairs.frame, w > MET, len(frames)) for r, w in adjusted.weighted]
    return np.array(rows, dtype=np.float64).T


def met_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Return the share (K,) of matchable detections met in each frame, by all sensors together."""
    met = _met_counts(adjusted, frames).sum(axis=1)
    return np.asarray(met / np.maximum(_matchable_counts(frames, task).sum(axis=1), 1))


def unmet_frames(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task, least: float) -> Mask:
    """Test (K, L) in which frames a sensor meets a smaller share than `least` of what it could."""
    return np.asarray(_met_counts(adjusted, frames) < least * _matchable_counts(frames, task))


def explained_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Return the share (L,) of matchable detections that the objective has met; NaN without any."""
    matchable = _matchable_counts(frames, task).sum(axis=0)
    met = np.array([weight.sum() for _, weight in adjusted.weighted])
    return np.asarray(np.where(matchable > 0, met / np.maximum(matchable, 1), np.nan))


def met_detections(adjusted: Adjusted, numbers: Sequence[int]) -> dict[int, MetDetections]:
    """Return the met detections of each sensor; `numbers` are those of the frames."""
    met, largest = {}, np.iinfo(np.intp).max
    for s, (rows, weight) in enumerate(adjusted.weighted):
        pairs, kept = rows.pairs, weight > MET
        # longer numbers than NumPy's only serve for display
        frames = np.array([min(n, largest) for n in numbers], dtype=np.intp)[pairs.frame[kept]]
        met[s] = MetDetections(pairs.y[kept], rows.residual[kept], frames, pairs.feature[kept])
    return met


def residuals_by(
    calibration: Calibration, kind: Literal["frame", "feature"]
) -> tuple[Indices, Floats]:
    """Return numbers (n,) of frames or features, and their RMS residuals in standard deviations."""
    keys, squares = [np.zeros(0, dtype=np.intp)], [np.zeros(0)]
    for sensor, met in calibration.met.items():
        keys.append(getattr(met, kind))
        squares.append((met.offset**2).sum(axis=1) / calibration.noise[sensor] ** 2)
    numbers, owners = np.unique(np.concatenate(keys), return_inverse=True)
    return numbers, np.sqrt(np.bincount(owners, np.concatenate(squares)) / np.bincount(owners))


@dataclass(frozen=True)
class Displacement:
    """How far a sensor is from its pose in the old calibration."""

    sensor: int  # its number in the rig
    name: str
    turn_deg: float  # relative to the consensus of the sensors, like the shift
    shift: float
    turn_deviation_deg: float
    shift_deviation: float
    residual_before: float  # sensor units; NaN if nothing was met
    residual_after: float  # of frames held back, if there are enough
    moved: bool


def displacements(calibration: Calibration, rules: CalibrationRules) -> tuple[Displacement, ...]:
    """Compare a calibration with the one it began from, for all sensors that share views."""
    rigs, names = (calibration.before, calibration.after), calibration.after.names
    linked = [k for k in range(len(names)) if k not in calibration.unlinked]
    G, deviations, displaced = _consensus(*rigs, linked), _deviations(calibration), []
    for index in linked:
        turn, shift = _displacement_of(*rigs, index, G)
        sd_turn, sd_shift = deviations[index]
        residual = calibration.residuals[index]
        before, after = residual.before, residual.held
        after = after if np.isfinite(after) else residual.after
        # a sensor that meets nothing at its old pose, but does now, surely stands elsewhere
        is_worse = bool(np.isfinite(after) and not before <= rules.worse * max(after, 1e-12))
        is_far = turn > rules.moved * sd_turn or shift > rules.moved * sd_shift
        values = turn, shift, sd_turn, sd_shift, before, after
        displaced.append(Displacement(index, names[index], *values, is_worse and is_far))
    return tuple(displaced)


def before_and_after(before: Rig, after: Rig, index: int) -> tuple[Floats, Floats] | None:
    """Return T_sensor_world of a sensor before and after; None of a range sensor."""
    old, new = (getattr(rig.sensors[index], "T_sensor_world", None) for rig in (before, after))
    return None if old is None or new is None else (old, new)


def _consensus(before: Rig, after: Rig, linked: Sequence[int]) -> Floats:
    """Return the motion (4, 4) of the world after which most linked sensors stand as before."""
    # the motion of the sensor from which the others differ least, so that bumped ones are outvoted
    poses = [before_and_after(before, after, k) for k in linked]
    motions_of_world = [inverse(pair[0]) @ pair[1] for pair in poses if pair is not None]
    if not motions_of_world:  # range sensors alone
        a, b = (np.array([centre_of(rig.sensors[k]) for k in linked]) for rig in (after, before))
        if len(a) < 3:
            return from_parts(np.eye(3), (b - a).mean(axis=0))
        return motions(a, b[None])[0]  # type: ignore[no-any-return]
    if len(motions_of_world) < 3:  # none of two can be outvoted
        return motions_of_world[0]
    worth = []
    for G in motions_of_world:
        apart = [_displacement_of(before, after, k, G) for k in linked]
        worth.append((np.median([t for t, _ in apart]), np.median([s for _, s in apart])))
    return motions_of_world[int(np.lexsort(np.array(worth).T[::-1])[0])]


def _displacement_of(before: Rig, after: Rig, index: int, G: Floats) -> tuple[float, float]:
    """Return turn (degrees) and shift of a sensor, after G moves the new world into the old one."""
    poses = before_and_after(before, after, index)
    if poses is None:
        centre = G[:3, :3] @ centre_of(after.sensors[index]) + G[:3, 3]
        return 0.0, float(np.linalg.norm(centre - centre_of(before.sensors[index])))
    old, moved = poses[0], poses[1] @ inverse(G)
    turn = Rotation.from_matrix(moved[:3, :3] @ old[:3, :3].T).magnitude()
    shift = np.linalg.norm(inverse(moved)[:3, 3] - inverse(old)[:3, 3])
    return float(np.degrees(turn)), float(shift)


def _deviations(calibration: Calibration) -> list[tuple[float, float]]:
    """Return standard deviations of turn (degrees) and shift of each sensor."""
    # a held sensor is as uncertain relative to the others as they are relative to it: the least
    deviations: dict[int, tuple[float, float]] = {}
    for block in calibration.blocks:
        if block.kind in ("pose", "position") and block.sensor is not None:
            values = calibration.deviations[block.place]
            turn = float(np.degrees(np.sqrt((values[3:] ** 2).sum())))  # 0 of a range sensor
            deviations[block.sensor] = (turn, float(np.sqrt((values[:3] ** 2).sum())))
    known = [(np.inf, np.inf), *deviations.values()]
    least = min(turn for turn, _ in known), min(shift for _, shift in known)
    return [deviations.get(index, least) for index in range(len(calibration.after.names))]

"""Rig and poses together: Gauss-Newton on the matched objective of all frames and sensors.

The unknowns are the free parameters of the rig (G) and a pose per frame.  Poses meet each other
only where motion between frames is interpolated, so that they are eliminated by sparse factors and
a dense system of G remains (Schur complement).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from mixpose.calibration.matching import Clock, Pairs, clock_of, interpolate
from mixpose.calibration.rig import Block, Rig, State, moved, parameter_jacobian
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import SeenFrame
from mixpose.objective.projection import pose_jacobian
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb
from mixpose.sensors import CalibrationError, calibration_shifts, perturbed


@dataclass(frozen=True, eq=False)
class Bundle:
    """The constants of an adjustment: frames, free parameters, conditions and rules."""

    frames: tuple[SeenFrame, ...]
    blocks: tuple[Block, ...]  # free parameters of the rig
    pose_free: Mask  # (6,): world directions of poses that are free; none if poses are known
    gauge: Callable[[Rig], Floats]  # conditions (r, G) on a step, in the parameters' sizes
    sigmas: Floats  # (L,): σ_ε by sensor
    rules: CalibrationRules
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)  # of held parameters

    @cached_property
    def clock(self) -> Clock:
        """Return the times of sensors."""
        return clock_of(self.frames, len(self.sigmas), self.rules.gap)

    @property
    def count(self) -> int:
        """Return G, the number of free parameters of the rig."""
        return sum(len(block.names) for block in self.blocks)

    @property
    def scales(self) -> Floats:
        """Return the sizes of the parameters (G,)."""
        return np.array([scale for block in self.blocks for scale in block.scales])


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of a sensor's pairs with their Jacobians."""

    pairs: Pairs
    residual: Floats  # (n, m): detected minus predicted
    by_pose: Floats  # (n, m, 6): by the pose at the moment of the sensor
    shares: Floats  # (n, 4): weights of the clock's nodes in that pose
    by_rig: Floats  # (n, m, G)
    by_held: Floats  # (n, m, c): by held parameters, per standard deviation
    known: Mask  # (n,): whether the moment of the sensor is known


Weighted: TypeAlias = tuple[Rows, Floats]
"""Rows of a sensor, and weights (n,) of its pairs."""


def rows_of(bundle: Bundle, state: State, sensor: int, pairs: Pairs) -> Rows:
    """Return residuals and Jacobians of a sensor's pairs."""
    rig, clock, frame = state.rig, bundle.clock, pairs.frame
    geometry, tau = rig.sensors[sensor], clock.tau(rig, sensor, frame, pairs.y)
    poses, n = state.poses[frame], len(tau)
    is_timed = any(b.sensor == sensor and b.kind in ("delay", "drift") for b in bundle.blocks)
    rate, shares, known = np.zeros((n, 6)), np.eye(1, 4).repeat(n, axis=0), np.ones(n, np.bool_)
    if is_timed or tau.any():
        between = interpolate(clock, state.poses, frame, tau)
        poses, rate, shares = perturb(poses, between.twist), between.rate, between.shares
        known = between.known | (np.abs(tau) < 1e-9)
    arms = np.einsum("nij,nj->ni", poses[:, :3, :3], rig.points[pairs.feature])
    world = arms + poses[:, :3, 3]
    y, by_world, visible = geometry.linearise(world)
    y = y + rig.centre_offsets(sensor, state.poses)[frame, pairs.feature]
    by_pose = pose_jacobian(by_world, arms)
    by_rig = np.zeros((*y.shape, bundle.count))
    for block in bundle.blocks:
        if block.kind == "body":
            columns = block.start + 3 * pairs.feature[:, None] + np.arange(3)
            columns = np.broadcast_to(columns[:, None], by_world.shape)
            np.put_along_axis(by_rig, columns, by_world @ poses[:, :3, :3], axis=2)
        elif block.sensor != sensor:
            continue
        elif block.kind in ("delay", "drift"):
            J = np.einsum("nmk,nk->nm", by_pose, rate)[..., None]
            if block.kind == "drift":
                J = J * clock.elapsed[sensor, frame][:, None, None]
            by_rig[:, :, block.place] = J
        else:
            J = parameter_jacobian(geometry, block.kind, world, by_world)
            by_rig[:, :, block.place] = J * (frame >= block.since)[:, None, None]
    by_held = np.zeros((*y.shape, 0))
    if sensor in bundle.errors:
        by_held = calibration_shifts(perturbed(geometry, bundle.errors[sensor]), world)
    return Rows(pairs, pairs.y - y, by_pose, shares, by_rig, by_held, known & visible)


def normal_equations(
    bundle: Bundle, weighted: Sequence[Weighted], damping: float
) -> tuple[Floats, Floats, Floats, Callable[[Floats], Floats]]:
    """Return the normal equations S δ = b of the rig (G, G), with poses eliminated."""
    # also the information (G, C) between the rig and held parameters, and a function from a step of
    # the rig to that of the poses. Weights include the inverse variance; `damping` is the share of
    # the diagonal that is added to the poses' part
    G, free = bundle.count, np.flatnonzero(bundle.pose_free)
    P = len(free) * len(bundle.frames)
    edges = G + np.cumsum([0] + [rows.by_held.shape[2] for rows, _ in weighted])
    Q = int(edges[-1])  # number of free and held parameters
    # all sensors at once, as overhead of SciPy takes longer than the sums
    A = np.zeros((sum(rows.residual.size for rows, _ in weighted), Q))
    parts, r, done = [], np.zeros(len(A)), 0
    for (rows, weight), start, stop in zip(weighted, edges, edges[1:]):
        root, size = np.sqrt(weight)[:, None, None], rows.residual.size
        sensor_rows = slice(done, done + size)
        A[sensor_rows, :G] = (rows.by_rig * root).reshape(size, G)
        A[sensor_rows, start:stop] = (rows.by_held * root).reshape(size, stop - start)
        r[sensor_rows] = (rows.residual * root[:, 0]).ravel()
        parts.append(_pose_columns(rows, bundle.clock, root, free))
        done += size
    H_gg, b_g = A.T @ A, A.T @ r
    if not P:
        return H_gg[:G, :G], H_gg[:G, G:], b_g[:G], lambda step: np.zeros(0)
    values, columns, filled = (np.concatenate(part) for part in zip(*parts, strict=True))
    B = sp.csr_matrix((values, columns, np.append(0, np.cumsum(filled))), shape=(len(A), P))
    H_pp, W, b_p = B.T @ B, B.T @ A, B.T @ r
    diagonal = H_pp.diagonal()
    floor = 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-30)
    factor = splu((H_pp + sp.diags(damping * diagonal + floor)).tocsc())
    X = factor.solve(np.column_stack([W[:, :G], b_p]))
    S = H_gg[:, :G] - W.T @ X[:, :-1]
    b = b_g[:G] - W[:, :G].T @ X[:, -1]
    return (S[:G] + S[:G].T) / 2, S[G:].T, b, lambda step: factor.solve(b_p - W[:, :G] @ step)


def _pose_columns(
    rows: Rows, clock: Clock, root: Floats, free: Indices
) -> tuple[Floats, Indices, Indices]:
    """Return weighted Jacobians (n m,) by free directions of poses: values, columns, and counts."""
    n, m = rows.residual.shape
    d = len(free)
    nodes = [0] if not rows.shares[:, 1:].any() else [0, 1, 2, 3]
    J = (rows.by_pose[:, :, free] * root)[:, :, None] * rows.shares[:, None, nodes, None]
    columns = clock.nodes[rows.pairs.frame][:, nodes, None] * d + np.arange(d)
    repeated = np.repeat(columns.reshape(n, 1, d * len(nodes)), m, axis=1)
    return J.ravel(), repeated.ravel(), np.full(n * m, d * len(nodes))


@dataclass(frozen=True, eq=False)
class Step:
    """A step of rig and poses."""

    rig: Floats  # (G,)
    poses: Floats  # (K, 6)
    covariance: Floats  # (G, G): of the rig, in the gauge, without undetermined directions
    of_held: Floats  # (G, G): added to it by errors of held parameters
    unknown: Floats  # (G, u): undetermined directions, in units of the parameters' sizes


def solve_step(
    bundle: Bundle, state: State, weighted: Sequence[Weighted], damping: float = 0.0
) -> Step:
    """Solve for a step within the gauge that leaves undetermined directions alone."""
    S, held, b, poses_step = normal_equations(bundle, weighted, damping)
    scales = bundle.scales
    S = S * np.outer(scales, scales)
    basis = _complement(bundle.gauge(state.rig), len(scales))
    inner = basis.T @ S @ basis
    pulls = scales[:, None] * held  # by held parameters that are a standard deviation off
    # with errors of held parameters, a solution x = I⁻¹ b has the covariance I⁻¹ (I + P Pᵀ) I⁻¹
    information, P = inner, basis.T @ pulls
    if P.any():
        information = inner @ np.linalg.pinv(inner + P @ P.T) @ inner
    values, vectors = np.linalg.eigh(information)
    known = values > 1.0 / bundle.rules.undetermined**2
    V = basis @ vectors[:, known]
    covariance = V @ np.linalg.inv(V.T @ S @ V) @ V.T
    step = scales * (covariance @ (scales * b))
    by_held = scales[:, None] * (covariance @ pulls)
    pose_steps = np.zeros((len(state.poses), 6))
    pose_steps[:, bundle.pose_free] = poses_step(step).reshape(len(pose_steps), -1)
    return Step(
        step,
        pose_steps,
        covariance * np.outer(scales, scales),
        by_held @ by_held.T,
        basis @ vectors[:, ~known],
    )


def _complement(gauge: Floats, count: int) -> Floats:
    """Return orthonormal columns (G, G − r) across the rows (r, G) of the gauge."""
    if not len(gauge):
        return np.eye(count)
    _, s, Vt = np.linalg.svd(gauge)
    rank = int(np.count_nonzero(s > 1e-10 * s.max(initial=0.0)))
    return np.asarray(Vt[rank:].T)


def apply_step(bundle: Bundle, state: State, step: Step) -> State:
    """Return rig and poses after a step."""
    rig, poses = moved(state.rig, bundle.blocks, step.rig), state.poses
    return State(rig, perturb(poses, step.poses) if bundle.pose_free.any() else poses)

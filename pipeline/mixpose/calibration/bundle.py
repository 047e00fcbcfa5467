"""Rig and poses together: Gauss-Newton on the matched objective of all frames and sensors.

The unknowns are the free parameters of the rig (G) and a pose per frame.  Poses meet each other
only where motion between frames is interpolated, so that they are eliminated by sparse factors
and a dense system of G remains (Schur complement).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.interpolation import interpolate
from mixpose.calibration.matching import Clock, Pairs
from mixpose.calibration.rig import Block, Rig, by_parameters, moved
from mixpose.objective.projection import pose_jacobian
from mixpose.records import Floats
from mixpose.rigid import perturb
from mixpose.sensors import CalibrationError, by_calibration, doubted


@dataclass(frozen=True, eq=False)
class Bundle:
    """What stays the same while a rig is adjusted."""

    frames: tuple[SeenFrame, ...]
    clock: Clock
    blocks: tuple[Block, ...]  # free parameters of the rig
    # (6,): world directions of the poses that are free; none where poses are known
    pose_free: NDArray[np.bool_]
    # standard deviation by a parameter's size above which a direction stays as it is
    undetermined: float
    # by sensor, how far what is held of it may be off
    errors: Mapping[int, CalibrationError] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Free parameters of the rig, G."""
        return sum(len(block.names) for block in self.blocks)

    @property
    def scales(self) -> Floats:
        """Sizes of the parameters (G,)."""
        parts = [np.array(block.scales) for block in self.blocks]
        return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of one sensor's pairs with their Jacobians."""

    residual: Floats  # (n, m): detected minus predicted
    by_pose: Floats  # (n, m, 6): by the pose at the moment of the sensor
    shares: Floats  # (n, 4): by how much that pose follows its neighbours'
    nodes: NDArray[np.intp]  # (n, 4)
    by_rig: list[tuple[Block, Floats]]  # (n, m, k) each
    by_point: Floats | None  # (n, m, 3): by the feature's coordinates, where the body is free
    by_held: Floats  # (n, m, c): by what is held, of a standard deviation each
    known: NDArray[np.bool_]  # (n,): whether the moment of the sensor is known


def rows_of(bundle: Bundle, rig: Rig, poses: Floats, sensor: int, pairs: Pairs) -> Rows:
    """Residuals and Jacobians of one sensor."""
    eye = rig.sensors[sensor]
    tau = bundle.clock.tau(rig, sensor, pairs.frame)
    at, n = poses[pairs.frame], len(tau)
    timed = any(b.sensor == sensor and b.kind in ("delay", "drift") for b in bundle.blocks)
    rate, shares, known = np.zeros((n, 6)), np.eye(1, 4).repeat(n, axis=0), np.ones(n, np.bool_)
    if timed or tau.any():
        between = interpolate(bundle.clock.near, poses, pairs.frame, tau)
        at, rate, shares = perturb(at, between.twist), between.rate, between.shares
        known = between.known | (np.abs(tau) < 1e-9)
    arms = np.einsum("nij,nj->ni", at[:, :3, :3], rig.points[pairs.feature])
    world = arms + at[:, :3, 3]
    y, by_world, visible = eye.linearise(world)
    by_pose = pose_jacobian(by_world, arms)
    by_rig: list[tuple[Block, Floats]] = []
    by_point = None
    for block in bundle.blocks:
        if block.kind == "body":
            by_point = by_world @ at[:, :3, :3]
        elif block.sensor != sensor:
            continue
        elif block.kind in ("delay", "drift"):
            J = np.einsum("nmk,nk->nm", by_pose, rate)[..., None]
            if block.kind == "drift":
                J = J * bundle.clock.since[sensor, pairs.frame][:, None, None]
            by_rig.append((block, J))
        else:
            by_rig.append((block, by_parameters(eye, block.kind, world, by_world)))
    nodes = bundle.clock.near.nodes[pairs.frame]
    by_held = np.zeros((*y.shape, 0))
    if sensor in bundle.errors:
        by_held = by_calibration(doubted(eye, bundle.errors[sensor]), world)
    return Rows(pairs.y - y, by_pose, shares, nodes, by_rig, by_point, by_held, known & visible)


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations H δ = b, poses eliminated."""

    S: Floats  # (G, G): information on the rig, the poses being unknown
    held: Floats  # (G, C): the same between the rig and what is held
    b: Floats  # (G,)
    pose_b: Floats  # what gives the poses' step from the rig's
    pose_solve: object = field(repr=False)
    W: Floats = field(repr=False)  # H_pg

    def poses_step(self, step: Floats) -> Floats:
        """The step of all poses (6K',) that belongs to a step of the rig."""
        if self.pose_solve is None:
            return np.zeros(0)
        return np.asarray(self.pose_solve.solve(self.pose_b - self.W @ step))  # type: ignore[attr-defined]


def normal_equations(
    bundle: Bundle,
    poses: int,
    rows: Sequence[tuple[int, Pairs, Rows, Floats]],
    damping: float,
) -> Normal:
    """Assemble and eliminate.

    Parameters
    ----------
    poses : int
        K.
    rows : sequence of (sensor, pairs, rows, weights)
        Weights (n,) include the inverse variance.
    damping : float
        Share of the diagonal that is added to the poses' part.
    """
    G, free = bundle.count, np.flatnonzero(bundle.pose_free)
    P = len(free) * poses
    edges = G + np.cumsum([0] + [each.by_held.shape[2] for _, _, each, _ in rows])
    Q = int(edges[-1])  # parameters that are free and that are held
    H_gg, b_g = np.zeros((Q, Q)), np.zeros(Q)
    W, b_p, H_pp = np.zeros((P, Q)), np.zeros(P), sp.csr_matrix((P, P))
    for (_, pairs, each, weight), start, stop in zip(rows, edges, edges[1:]):
        root = np.sqrt(weight)
        A = _rig_columns(bundle, pairs, each, Q)
        A[:, :, start:stop] = each.by_held
        A = (A * root[:, None, None]).reshape(each.residual.size, Q)
        r = (each.residual * root[:, None]).ravel()
        H_gg += A.T @ A
        b_g += A.T @ r
        if P:
            B = _pose_columns(each, root, free, P)
            H_pp, W, b_p = H_pp + B.T @ B, W + B.T @ A, b_p + B.T @ r
    if not P:
        return Normal(H_gg[:G, :G], H_gg[:G, G:], b_g[:G], b_p, None, W[:, :G])
    diagonal = H_pp.diagonal()
    floor = 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-30)
    factor = splu((H_pp + sp.diags(damping * diagonal + floor)).tocsc())
    X = factor.solve(np.column_stack([W[:, :G], b_p]))
    S = H_gg[:, :G] - W.T @ X[:, :-1]
    b = b_g[:G] - W[:, :G].T @ X[:, -1]
    return Normal((S[:G] + S[:G].T) / 2, S[G:].T, b, b_p, factor, W[:, :G])


def _rig_columns(bundle: Bundle, pairs: Pairs, rows: Rows, count: int) -> Floats:
    n, m = rows.residual.shape
    A = np.zeros((n, m, count))
    for block, J in rows.by_rig:
        A[:, :, block.place] = J
    if rows.by_point is not None:
        start = next(block.start for block in bundle.blocks if block.kind == "body")
        columns = start + 3 * pairs.feature[:, None] + np.arange(3)
        A[np.arange(n)[:, None, None], np.arange(m)[None, :, None], columns[:, None, :]] = (
            rows.by_point
        )
    return A


def _pose_columns(rows: Rows, root: Floats, free: NDArray[np.intp], P: int) -> sp.csr_matrix:
    n, m = rows.residual.shape
    d = len(free)
    used = [0] if not rows.shares[:, 1:].any() else [0, 1, 2, 3]
    J = rows.by_pose[:, :, free] * root[:, None, None]
    value, column = [], []
    for node in used:
        value.append(J * rows.shares[:, node, None, None])
        place = rows.nodes[:, node, None] * d + np.arange(d)
        column.append(np.repeat(place[:, None, :], m, axis=1))
    values = np.concatenate(value, axis=2).ravel()
    columns = np.concatenate(column, axis=2).ravel()
    row = np.repeat(np.arange(n * m), d * len(used))
    return sp.csr_matrix((values, (row, columns)), shape=(n * m, P))


@dataclass(frozen=True, eq=False)
class Step:
    """A step of rig and poses."""

    rig: Floats  # (G,)
    poses: Floats  # (K, 6)
    # (G, G): of the rig, in the gauge; directions that are not determined left out
    covariance: Floats
    of_held: Floats  # (G, G): what errors of the held parameters add to it
    unknown: Floats  # (G, u): directions that are not determined, in units of the parameters' sizes


def solved(bundle: Bundle, normal: Normal, gauge: Floats, poses: int) -> Step:
    """Solve within the gauge, leaving alone what the data do not determine.

    Parameters
    ----------
    gauge : (r, G) array
        Rows of the conditions on the step, in the parameters' sizes.
    poses : int
        K.
    """
    scales = bundle.scales
    S = normal.S * np.outer(scales, scales)
    basis = _complement(gauge, len(scales))
    inner = basis.T @ S @ basis
    pulls = scales[:, None] * normal.held  # of held parameters that are a standard deviation off
    told = _told(inner, basis.T @ pulls)
    values, vectors = np.linalg.eigh((told + told.T) / 2)
    known = values > 1.0 / bundle.undetermined**2
    V = basis @ vectors[:, known]
    covariance = V @ np.linalg.inv(V.T @ S @ V) @ V.T
    step = scales * (covariance @ (scales * normal.b))
    by_held = scales[:, None] * (covariance @ pulls)
    free = np.flatnonzero(bundle.pose_free)
    pose_steps = np.zeros((poses, 6))
    if len(free):
        pose_steps[:, free] = normal.poses_step(step).reshape(poses, len(free))
    return Step(
        step,
        pose_steps,
        covariance * np.outer(scales, scales),
        by_held @ by_held.T,
        basis @ vectors[:, ~known],
    )


def _told(information: Floats, pulls: Floats) -> Floats:
    """Information (g, g) that is left where held parameters are off.

    A solution x = I⁻¹ b then has the covariance I⁻¹ (I + P Pᵀ) I⁻¹.
    """
    if not pulls.any():
        return information
    return np.asarray(information @ np.linalg.pinv(information + pulls @ pulls.T) @ information)


def _complement(gauge: Floats, count: int) -> Floats:
    """Orthonormal columns (G, G − r) across the rows of the gauge."""
    if not len(gauge):
        return np.eye(count)
    _, s, Vt = np.linalg.svd(gauge)
    rank = int(np.count_nonzero(s > 1e-10 * s.max(initial=0.0)))
    return np.asarray(Vt[rank:].T)


def stepped(bundle: Bundle, rig: Rig, poses: Floats, step: Step) -> tuple[Rig, Floats]:
    """Rig and poses after a step."""
    rig = moved(rig, bundle.blocks, step.rig)
    if bundle.pose_free.any():
        poses = perturb(poses, step.poses)
    return rig, poses

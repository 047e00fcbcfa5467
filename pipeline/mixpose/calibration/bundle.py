"""Rig and poses together: Gauss-Newton on the matched objective of all frames and sensors.

The unknowns are the free parameters of the rig (G) and a pose per frame.  Poses meet each other
only where motion between frames is interpolated, so that they are eliminated by sparse factors
and a dense system of G remains (Schur complement).
"""

from __future__ import annotations

from collections.abc import Sequence
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


@dataclass(frozen=True, eq=False)
class Bundle:
    """What stays the same while a rig is adjusted.

    Attributes
    ----------
    frames : tuple of SeenFrame
    clock : Clock
    blocks : tuple of Block
        Free parameters of the rig.
    pose_free : (6,) bool
        World directions of the poses that are free; none where poses are known.
    undetermined : float
        Standard deviation by a parameter's size above which a direction stays as it is.
    """

    frames: tuple[SeenFrame, ...]
    clock: Clock
    blocks: tuple[Block, ...]
    pose_free: NDArray[np.bool_]
    undetermined: float

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
    """Residuals of one sensor's pairs with their Jacobians.

    Attributes
    ----------
    residual : (n, m) float64
        Detected minus predicted.
    by_pose : (n, m, 6) float64
        By the pose at the moment of the sensor.
    shares : (n, 4) float64
        By how much that pose follows its neighbours'.
    nodes : (n, 4) int
    by_rig : list of (Block, (n, m, k) float64)
    features : (n, 3) or None
        Columns of the body.
    known : (n,) bool
        Whether the moment of the sensor is known.
    """

    residual: Floats
    by_pose: Floats
    shares: Floats
    nodes: NDArray[np.intp]
    by_rig: list[tuple[Block, Floats]]
    by_point: Floats | None
    known: NDArray[np.bool_]


def rows_of(bundle: Bundle, rig: Rig, poses: Floats, sensor: int, pairs: Pairs) -> Rows:
    """Residuals and Jacobians of one sensor."""
    eye = rig.sensors[sensor]
    tau = bundle.clock.tau(rig, sensor, pairs.frame)
    between = interpolate(bundle.clock.near, poses, pairs.frame, tau)
    late = bool(tau.any())
    at = poses[pairs.frame]
    if late:
        at = perturb(at, between.twist)
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
            J = np.einsum("nmk,nk->nm", by_pose, between.rate)[..., None]
            if block.kind == "drift":
                J = J * bundle.clock.since[sensor, pairs.frame][:, None, None]
            by_rig.append((block, J))
        else:
            by_rig.append((block, by_parameters(eye, block.kind, world, by_world)))
    shares = between.shares if late else np.eye(1, 4).repeat(len(tau), axis=0)
    known = visible & (between.known | (np.abs(tau) < 1e-9))
    nodes = bundle.clock.near.nodes[pairs.frame]
    return Rows(pairs.y - y, by_pose, shares, nodes, by_rig, by_point, known)


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations H δ = b, poses eliminated.

    Attributes
    ----------
    S : (G, G) float64
        Information on the rig, the poses being unknown.
    b : (G,) float64
    back : callable parts
        What gives the poses' step from the rig's.
    """

    S: Floats
    b: Floats
    pose_b: Floats
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
    bundle : Bundle
    poses : int
        K.
    rows : sequence of (sensor, pairs, rows, weights)
        Weights (n,) include the inverse variance.
    damping : float
        Share of the diagonal that is added to the poses' part.
    """
    G, free = bundle.count, np.flatnonzero(bundle.pose_free)
    P = len(free) * poses
    H_gg, b_g = np.zeros((G, G)), np.zeros(G)
    pieces: list[sp.csr_matrix] = []
    for _, pairs, each, weight in rows:
        n, m = each.residual.shape
        root = np.sqrt(weight)
        A = _rig_columns(bundle, pairs, each, G) * root[:, None, None]
        r = each.residual * root[:, None]
        if P:
            B = _pose_columns(each, root, free, P)
            flat = A.reshape(n * m, G)
            pieces.append(sp.hstack([sp.csr_matrix(flat), B, sp.csr_matrix(r.reshape(-1, 1))]))
        else:
            flat = A.reshape(n * m, G)
            H_gg += flat.T @ flat
            b_g += flat.T @ r.ravel()
    if not P:
        return Normal(H_gg, b_g, np.zeros(0), None, np.zeros((0, G)))
    J = sp.vstack(pieces).tocsc()
    H = (J.T @ J).tocsc()
    H_pp = H[G : G + P, G : G + P].tocsc()
    diagonal = H_pp.diagonal()
    floor = 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-30)
    H_pp = H_pp + sp.diags(damping * diagonal + floor)
    factor = splu(H_pp.tocsc())
    W = H[G : G + P, :G].toarray()
    b_p = H[G : G + P, -1].toarray()[:, 0]
    X = factor.solve(np.column_stack([W, b_p]))
    S = H[:G, :G].toarray() - W.T @ X[:, :-1]
    b = H[:G, -1].toarray()[:, 0] - W.T @ X[:, -1]
    return Normal((S + S.T) / 2, b, b_p, factor, W)


def _rig_columns(bundle: Bundle, pairs: Pairs, rows: Rows, G: int) -> Floats:
    n, m = rows.residual.shape
    A = np.zeros((n, m, G))
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
    """A step of rig and poses.

    Attributes
    ----------
    rig : (G,) float64
    poses : (K, 6) float64
    covariance : (G, G) float64
        Of the rig, in the gauge; directions that are not determined left out.
    unknown : (G, u) float64
        Directions that are not determined, in units of the parameters' sizes.
    """

    rig: Floats
    poses: Floats
    covariance: Floats
    unknown: Floats


def solved(bundle: Bundle, normal: Normal, gauge: Floats, poses: int) -> Step:
    """Solve within the gauge, leaving alone what the data do not determine.

    Parameters
    ----------
    bundle : Bundle
    normal : Normal
    gauge : (r, G) array
        Rows of the conditions on the step, in the parameters' sizes.
    poses : int
        K.
    """
    scales = bundle.scales
    S = normal.S * np.outer(scales, scales)
    basis = _complement(gauge, len(scales))
    inner = basis.T @ S @ basis
    values, vectors = np.linalg.eigh((inner + inner.T) / 2)
    known = values > 1.0 / bundle.undetermined**2
    V = basis @ vectors[:, known]
    covariance = (V / values[known]) @ V.T
    step = scales * (covariance @ (scales * normal.b))
    free = np.flatnonzero(bundle.pose_free)
    pose_steps = np.zeros((poses, 6))
    if len(free):
        pose_steps[:, free] = normal.poses_step(step).reshape(poses, len(free))
    return Step(step, pose_steps, covariance * np.outer(scales, scales), basis @ vectors[:, ~known])


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

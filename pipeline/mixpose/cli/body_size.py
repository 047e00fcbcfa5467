"""Whether a body was given larger or smaller than it is, told by how its features were met."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mixpose.checking import times_as_large
from mixpose.objective import pose_jacobian
from mixpose.records import Estimate, Floats
from mixpose.session import Session

_FEWEST = 5  # frames before anything is said
_FEATURES = 4  # of a body: three in any other size are three in another place
_SHARE = 0.8  # of all squared offsets that the other size explains; one wrong marker stays below
_LEAST = 1e-3  # a body measured to less than that is measured well
_SEEN = 1e-3  # of what a change of size does to the features, what no other pose does as well


class BodySize:
    """Sums over frames of what another size of a body would explain of its offsets.

    To first order a feature at p from the body's middle goes by c R p where the body is 1 + c
    times as large, beside what the six directions of the pose do.
    """

    def __init__(self, session: Session, means: Floats) -> None:
        self._arms = means - means.mean(axis=0)
        self._sigmas = {setup.name: setup.extract.sigma for setup in session.sensors}
        self._curvature = self._pull = self._squares = 0.0
        self._frames = 0

    def add(self, estimate: Estimate) -> None:
        """Count a frame that is ok."""
        if len(self._arms) < _FEATURES or estimate.T_world_object is None:
            return
        arms = self._arms @ estimate.T_world_object[:3, :3].T
        normal, pull, squares = np.zeros((7, 7)), np.zeros(7), 0.0
        for name, one in estimate.offsets.items():
            met = np.flatnonzero(one.met)
            if not len(met):
                continue
            own, J = arms[one.features[met]], one.by_shift[met] / self._sigmas[name]
            columns = [pose_jacobian(J, own), J @ own[..., None]]
            A = np.concatenate(columns, axis=2).reshape(-1, 7)
            y = one.offsets[met].ravel() / self._sigmas[name]
            normal, pull, squares = normal + A.T @ A, pull + A.T @ y, squares + float(y @ y)
        if not normal.any():
            return
        pose = np.linalg.pinv(normal[:6, :6], hermitian=True)
        across = normal[6, :6] @ pose
        curvature = float(normal[6, 6] - across @ normal[:6, 6])
        self._frames += 1
        if curvature > _SEEN * normal[6, 6]:
            self._curvature += curvature
            self._pull += float(pull[6] - across @ pull[:6])
            self._squares += max(squares - float(pull[:6] @ pose @ pull[:6]), 0.0)

    def factor(self) -> float | None:
        """How many times as large the body fits best; None where its size is no matter."""
        if self._frames < _FEWEST or not self._curvature or not self._squares:
            return None
        change = self._pull / self._curvature
        explained = self._pull * change / self._squares
        return 1 + change if explained > _SHARE and abs(change) > _LEAST else None


def size_warnings(sizes: Mapping[str, BodySize]) -> list[str]:
    """A line for each body, by its label, that fits better in another size."""
    factors = {label: size.factor() for label, size in sizes.items()}
    return [
        f"the features of {label!r} are met as if it were {times_as_large(factor)}: were its "
        "points measured or entered wrong, or are the places of the sensors?"
        for label, factor in factors.items()
        if factor is not None
    ]

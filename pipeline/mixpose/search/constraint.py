"""World directions that are not free stay where a reference pose has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.rigid import from_parts

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Constraint:
    """Which directions may differ from a reference.

    Attributes
    ----------
    free : (6,) bool
    T_reference : (4, 4) float64
        Looked at only where a direction is not free.
    """

    free: NDArray[np.bool_]
    T_reference: Floats

    @property
    def shifts(self) -> NDArray[np.bool_]:
        """Free directions of translation (3,)."""
        return self.free[:3]

    @property
    def turns(self) -> NDArray[np.bool_]:
        """Free axes of rotation (3,)."""
        return self.free[3:]

    def apply(self, poses: Floats) -> Floats:
        """The allowed poses nearest to poses (H, 4, 4)."""
        if self.free.all() or len(poses) == 0:
            return poses
        R, t = poses[:, :3, :3], poses[:, :3, 3]
        t = np.where(self.shifts, t, self.T_reference[:3, 3])
        if not self.turns.all():
            relative = Rotation.from_matrix(R @ self.T_reference[:3, :3].T)
            R = self._allowed_turns(relative) @ self.T_reference[:3, :3]
        return from_parts(R, t)

    def _allowed_turns(self, relative: Rotation) -> Floats:
        if self.turns.sum() == 1:
            # of swing and twist the twist alone
            axis = int(np.flatnonzero(self.turns)[0])
            quaternions = relative.as_quat()
            vectors = np.zeros((len(quaternions), 3))
            vectors[:, axis] = 2 * np.arctan2(quaternions[:, axis], quaternions[:, 3])
        else:
            vectors = np.where(self.turns, relative.as_rotvec(), 0.0)
        return np.asarray(Rotation.from_rotvec(vectors).as_matrix(), dtype=np.float64)

"""Detect markers that are displaced on the body, or all of them because its size is wrong."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from mixpose.checking import times_as_large
from mixpose.objective import pose_jacobian
from mixpose.records import Estimate, Floats
from mixpose.session import Session

MOVED = "moved?"

_GONE = 0.25  # share of the frames where a marker is expected, missed up to the end: it fell off
_FEWEST = 10  # frames where a marker is expected before it is judged
_MEASURED = 4.0  # times the offset of other markers from which a marker is displaced
_SURE = 100.0  # squares that a displacement explains, over the variance, which are no chance
_KEPT = 32  # stretches of frames whose sums show when a marker moved

_SIZED = 5  # frames before the size of a body is judged
_FEATURES = 4  # fewest of a body: another size of three looks like another pose of them
_SHARE = 0.8  # of all squared offsets that the other size explains; one wrong marker stays below
_LEAST = 1e-3  # smallest change of size that is reported: such a body is measured well
_SEEN = 1e-3  # share of the effect of a change of size that no change of pose imitates


class _Sums(NamedTuple):
    """Sums over a stretch of frames that fit a displacement of a marker in the body's axes."""

    first: int  # frame
    met: int = 0  # frames in which the marker was met
    squares: float = 0.0  # weighted squares of offsets
    views: float = 0.0  # sum of weights
    normal: Floats = np.zeros((3, 3))  # matrix of normal equations
    pull: Floats = np.zeros(3)  # their right-hand side

    def plus(self, later: _Sums) -> _Sums:
        return _Sums(self.first, *map(operator.add, self[1:], later[1:]))

    def shift(self) -> Floats:
        """Return the displacement (3,) in the body's axes that explains the offsets best."""
        scale = max(float(np.trace(self.normal)), 1e-300)
        regular = self.normal + 1e-9 * scale * np.eye(3)
        return np.asarray(np.linalg.solve(regular, self.pull))

    def explained(self) -> float:
        """Return the part of the squares that this displacement explains."""
        return float(self.pull @ self.shift())


def _remaining_variance(whole: _Sums, since: _Sums) -> float:
    return max((whole.squares - since.explained()) / max(whole.views, 1e-12), 1e-12)


class Marker:
    """Statistics of how one marker was met."""

    def __init__(self) -> None:
        self.expected = 0
        self.since: int | None = None  # first of the latest frames in which it was missed
        self.missed_since = 0
        self.stretches: list[_Sums] = []
        self._longest = 1  # frames that a stretch may have

    def add(self, frame: int, seen: Sequence[tuple[float, Floats, Floats]] | None) -> None:
        """Count a frame: weights, offsets and Jacobians in the body's axes; None if not met."""
        self.expected += 1
        if seen is None:
            self.since = frame if self.since is None else self.since
            self.missed_since += 1
            return
        self.since, self.missed_since = None, 0
        squares, views, normal, pull = 0.0, 0.0, np.zeros((3, 3)), np.zeros(3)
        for weight, offset, J in seen:
            squares += weight * float(offset @ offset)
            views += weight
            normal += weight * J.T @ J
            pull += weight * J.T @ offset
        sums = _Sums(frame, 1, squares, views, normal, pull)
        if self.stretches and self.stretches[-1].met < self._longest:
            self.stretches[-1] = self.stretches[-1].plus(sums)
            return
        if len(self.stretches) == _KEPT:
            pairs = zip(self.stretches[::2], self.stretches[1::2], strict=True)
            self.stretches = [earlier.plus(later) for earlier, later in pairs]
            self._longest *= 2
        self.stretches.append(sums)

    @property
    def whole(self) -> _Sums:
        """The sums over all frames."""
        return reduce(_Sums.plus, self.stretches, _Sums(0))

    def displaced(self) -> tuple[_Sums, float]:
        """Return the final stretch in which it is displaced, and the variance that remains then.

        These are all frames, unless a displacement since one of them surely explains more.
        """
        *ends, whole = accumulate(reversed(self.stretches), lambda later, sums: sums.plus(later))
        since = [end for end in ends if end.met >= _FEWEST <= whole.met - end.met]
        latest = max(since, key=_Sums.explained, default=whole)
        gain = latest.explained() - whole.explained()
        displaced = latest if gain > _SURE * _remaining_variance(whole, latest) else whole
        return displaced, _remaining_variance(whole, displaced)

    def oddness(self, typical: float, unit: str) -> str | None:
        """Return what is odd about it in words; `typical` is the mean square of other markers."""
        if self.expected < _FEWEST:
            return None
        whole = self.whole
        if not whole.met:
            return (
                f"met in none of {self.expected} frames where it should be seen: gone, or "
                "measured wrong?"
            )
        since, variance = self.displaced()
        explained = since.explained()
        # in few frames a displacement explains any offsets
        sure = explained / variance > _SURE and since.met >= _FEWEST
        if sure and explained > _MEASURED**2 * typical * since.views:
            off = f"met {float(np.linalg.norm(since.shift())):.2g} {unit} off"
            if since.met < whole.met:
                return f"{off} from frame {since.first} on, in {since.met} frames: {MOVED}"
            return f"{off} in {whole.met} of {self.expected} frames: measured wrong?"
        # tested last, as a displaced marker is also missed where it is too far off
        gone = self.missed_since
        if self.since is not None and gone >= max(_FEWEST, _GONE * self.expected):
            return f"not met from frame {self.since} on, in {gone} frames: gone?"
        return None


def add_markers(markers: dict[int, Marker], estimate: Estimate) -> None:
    """Count how the markers of a body are met in a frame that is ok."""
    T = estimate.T_world_object
    assert T is not None
    seen: dict[int, list[tuple[float, Floats, Floats]]] = {}
    for name, offsets in estimate.offsets.items():
        if (estimate.sensors[name].explained or 0.0) < 0.1:  # the sensor hardly sees the body
            continue
        for k, i in enumerate(offsets.features.tolist()):
            of_marker = seen.setdefault(i, [])
            if offsets.met[k]:
                J = offsets.by_shift[k] @ T[:3, :3]
                of_marker.append((float(offsets.weights[k]), offsets.offsets[k], J))
    for i, of_marker in seen.items():
        markers.setdefault(i, Marker()).add(estimate.frame, of_marker or None)


def marker_lines(
    markers: Mapping[int, Marker], labels: Sequence[str], of: str, unit: str
) -> list[str]:
    """Return a line for each oddity of the markers of a body, with its name (`of`)."""
    wholes = {i: marker.whole for i, marker in markers.items()}
    means = {i: sums.squares / sums.views for i, sums in wholes.items() if sums.views}
    by_text = dict[str, list[int]]()
    for i, marker in sorted(markers.items()):
        others = [mean for j, mean in means.items() if j != i]
        typical = float(np.median(others)) if i in means and len(others) > 1 else np.inf
        if text := marker.oddness(typical, unit):
            by_text.setdefault(text, []).append(i)
    lines = []
    for text, numbers in by_text.items():  # in ascending order
        names = [labels[i] for i in numbers]
        in_a_row = len(names) > 2 and numbers[-1] - numbers[0] == len(names) - 1
        listed = f"{names[0]} to {names[-1]}" if in_a_row else ", ".join(names)
        many = len(names) > 1
        lines.append(f"marker{'s' * many} {listed}{of} {'are each' if many else 'is'} {text}")
    return lines


class BodySize:
    """Sums over frames that fit another size of a body to its offsets.

    If the body is 1 + c times as large, a feature at p from its middle moves by c R p to first
    order, in addition to the effects of the six directions of the pose.
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
        for name, offsets in estimate.offsets.items():
            met = np.flatnonzero(offsets.met)
            if not len(met):
                continue
            arms_met, J = arms[offsets.features[met]], offsets.by_shift[met] / self._sigmas[name]
            columns = [pose_jacobian(J, arms_met), J @ arms_met[..., None]]
            A = np.concatenate(columns, axis=2).reshape(-1, 7)
            y = offsets.offsets[met].ravel() / self._sigmas[name]
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
        """Return the factor of size that fits best; None if the size explains little."""
        if self._frames < _SIZED or not self._curvature or not self._squares:
            return None
        change = self._pull / self._curvature
        explained = self._pull * change / self._squares
        return 1 + change if explained > _SHARE and abs(change) > _LEAST else None


def size_warnings(sizes: Mapping[str, BodySize]) -> list[str]:
    """Return a line for each body, by its label, that fits better in another size."""
    factors = {label: size.factor() for label, size in sizes.items()}
    return [
        f"the features of {label!r} are met as if it were {times_as_large(factor)}: were its "
        "points measured or entered wrong, or are the places of the sensors?"
        for label, factor in factors.items()
        if factor is not None
    ]

"""Markers that a run met elsewhere than the body has them; all of them, where its size is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import accumulate

import numpy as np

from mixpose.checking import times_as_large
from mixpose.objective import pose_jacobian
from mixpose.records import Estimate, Floats
from mixpose.session import Session

MOVED = "moved?"

_GONE = 0.25  # of the frames in which a marker should be seen, at their end: it fell off
_FEWEST = 10  # frames in which a marker should have been seen before anything is said of it
_MEASURED = 4.0  # times what the other markers are off: a marker that is not where it should be
_SURE = 100.0  # squared offset in its own noise from which that is no chance
_KEPT = 32  # stretches of frames by whose sums it is told when a marker moved

_SIZED = 5  # frames before the size of a body is spoken of
_FEATURES = 4  # of a body: three in any other size are three in another place
_SHARE = 0.8  # of all squared offsets that the other size explains; one wrong marker stays below
_LEAST = 1e-3  # a body measured to less than that is measured well
_SEEN = 1e-3  # of what a change of size does to the features, what no other pose does as well


@dataclass
class _Sums:
    """Of a stretch of frames: by what displacement in the body's axes a marker is met off."""

    first: int  # frame
    met: int = 0  # frames
    squares: float = 0.0  # of the offsets of whole spots, each by what it tells
    views: float = 0.0
    normal: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    pull: Floats = field(default_factory=lambda: np.zeros(3))

    def __add__(self, after: _Sums) -> _Sums:
        return _Sums(
            self.first,
            self.met + after.met,
            self.squares + after.squares,
            self.views + after.views,
            self.normal + after.normal,
            self.pull + after.pull,
        )

    def shift(self) -> Floats:
        """Displacement in the body's axes that explains its offsets best (3,)."""
        scale = max(float(np.trace(self.normal)), 1e-300)
        inner = self.normal + 1e-9 * scale * np.eye(3)
        return np.asarray(np.linalg.solve(inner, self.pull))

    def explained(self) -> float:
        """How much of the squares this displacement takes away."""
        return float(self.pull @ self.shift())


def _left(whole: _Sums, since: _Sums) -> float:
    """Variance of all views where those of a stretch are displaced."""
    return max((whole.squares - since.explained()) / max(whole.views, 1e-12), 1e-12)


class Marker:
    """How one marker was met."""

    def __init__(self) -> None:
        self.expected = 0
        self.since: int | None = None  # first frame since which it was not met
        self.missed_since = 0
        self.stretches: list[_Sums] = []
        self._longest = 1  # frames that a stretch may have

    def add(self, frame: int, seen: Sequence[tuple[float, Floats, Floats]] | None) -> None:
        """Count a frame: weights, offsets and Jacobians in the body's axes, None where not met."""
        self.expected += 1
        if seen is None:
            self.since = frame if self.since is None else self.since
            self.missed_since += 1
            return
        self.since, self.missed_since = None, 0
        sums = _Sums(frame, 1)
        for weight, offset, J in seen:
            sums.squares += weight * float(offset @ offset)
            sums.views += weight
            sums.normal += weight * J.T @ J
            sums.pull += weight * J.T @ offset
        if self.stretches and self.stretches[-1].met < self._longest:
            self.stretches[-1] += sums
            return
        if len(self.stretches) == _KEPT:
            pairs = zip(self.stretches[::2], self.stretches[1::2], strict=True)
            self.stretches = [one + other for one, other in pairs]
            self._longest *= 2
        self.stretches.append(sums)

    @property
    def whole(self) -> _Sums:
        """Sums over all frames."""
        return reduce(_Sums.__add__, self.stretches, _Sums(0))

    def displaced(self) -> tuple[_Sums, float]:
        """The stretch up to the end in which it is elsewhere, and the variance that this leaves.

        All frames, unless what shows since one of them explains surely more.
        """
        *others, whole = accumulate(reversed(self.stretches), lambda after, one: one + after)
        since = [one for one in others if one.met >= _FEWEST <= whole.met - one.met]
        latest = max(since, key=_Sums.explained, default=whole)
        is_surely = latest.explained() - whole.explained() > _SURE * _left(whole, latest)
        one = latest if is_surely else whole
        return one, _left(whole, one)

    def oddness(self, typical: float, unit: str) -> str | None:
        """What is odd about it in words, by how far off others are (squares a view)."""
        if self.expected < _FEWEST:
            return None
        whole = self.whole
        if not whole.met:
            return (
                f"met in none of {self.expected} frames where it should be seen: gone, or "
                "measured wrong?"
            )
        since, own = self.displaced()
        explained = since.explained()
        # of a few frames a displacement takes up all
        sure = explained / own > _SURE and since.met >= _FEWEST
        if sure and explained > _MEASURED**2 * typical * since.views:
            off = f"met {float(np.linalg.norm(since.shift())):.2g} {unit} off"
            if since.met < whole.met:
                return f"{off} from frame {since.first} on, in {since.met} frames: {MOVED}"
            return f"{off} in {whole.met} of {self.expected} frames: measured wrong?"
        # one that is measured wrong is missed, too, wherever it is too far off
        gone = self.missed_since
        if self.since is not None and gone >= max(_FEWEST, _GONE * self.expected):
            return f"not met from frame {self.since} on, in {gone} frames: gone?"
        return None


def add_markers(markers: dict[int, Marker], estimate: Estimate) -> None:
    """Count how the markers of a body are met in a frame that is ok."""
    T = estimate.T_world_object
    assert T is not None
    seen: dict[int, list[tuple[float, Floats, Floats]]] = {}
    for name, one in estimate.offsets.items():
        if (estimate.sensors[name].explained or 0.0) < 0.1:  # what it sees is not the body
            continue
        for k, i in enumerate(one.features.tolist()):
            of_marker = seen.setdefault(i, [])
            if one.met[k]:
                J = one.by_shift[k] @ T[:3, :3]
                of_marker.append((float(one.weights[k]), one.offsets[k], J))
    for i, of_marker in seen.items():
        markers.setdefault(i, Marker()).add(estimate.frame, of_marker or None)


def marker_lines(
    markers: Mapping[int, Marker], labels: Sequence[str], of: str, unit: str
) -> list[str]:
    """What is odd about markers of a body (its name in words, `of`), a line each."""
    wholes = {i: one.whole for i, one in markers.items()}
    means = {i: one.squares / one.views for i, one in wholes.items() if one.views}
    told = dict[str, list[int]]()
    for i, marker in sorted(markers.items()):
        others = [mean for j, mean in means.items() if j != i]
        typical = float(np.median(others)) if i in means and len(others) > 1 else np.inf
        if text := marker.oddness(typical, unit):
            told.setdefault(text, []).append(i)
    lines = []
    for text, numbers in told.items():  # which rise
        names = [labels[i] for i in numbers]
        in_a_row = len(names) > 2 and numbers[-1] - numbers[0] == len(names) - 1
        called = f"{names[0]} to {names[-1]}" if in_a_row else ", ".join(names)
        several = len(names) > 1
        lines.append(f"marker{'s' * several} {called}{of} {'are each' if several else 'is'} {text}")
    return lines


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
        if self._frames < _SIZED or not self._curvature or not self._squares:
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

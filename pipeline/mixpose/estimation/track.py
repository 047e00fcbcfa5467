"""What is known between two frames: where the body may be, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.estimation.evidence import Noise, Prior, flat_prior
from mixpose.rigid import perturb, rotation_angle_deg, twist_between

Floats: TypeAlias = NDArray[np.float64]

COASTING = 5  # frames for which a velocity is believed without a pose
_STEADY_ROTATION_DEG = 1.0
_STEADY_DISTANCE_SHARE = 0.03  # of the body's radius
_WIDENING = 1.5  # per frame without a pose
_WIDEST = 4.0
_UNKNOWN_ROTATION_DEG = 30.0  # from one frame to the next, before any motion was seen
_UNKNOWN_DISTANCE_SHARE = 1.0  # of the body's radius
_GUESSED = 0.2  # of a displacement that was seen: what the guess before counts
_RECALL = 0.95  # per frame, of displacements before
_LEAST_SHARE = 0.25  # of squared displacements of features by shifts: those by turns, and reverse
_PERSISTENCE = 1.5
_SURPRISE = 0.02  # chance per frame that the body is somewhere else than predicted


@dataclass(frozen=True)
class Branch:
    """One place where the body may be.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    weight : float
        Belief in this branch among its rivals.
    velocity : (6,) float64 or None
        Twist per second where frames have times, else per frame.
    uncertainty : (6,) float64
        Standard deviations of the next pose about the prediction.
    spread : (6,) float64 or None
        Standard deviations of the pose itself, where they are as large as its motion: then the
        next frame takes it as a prior, and no velocity is believed.
    steady : (6,) float64 or None
        Mean of the last two velocities: less of a pose's own error is in it.
    """

    T_world_object: Floats
    weight: float
    velocity: Floats | None
    uncertainty: Floats
    spread: Floats | None = None
    steady: Floats | None = None


@dataclass(frozen=True)
class Stride:
    """How far the body moves from frame to frame, learnt from uncertain poses.

    Attributes
    ----------
    rates : (6,) float64
        Sum of squared displacements over the time that they took.
    count : float
        Of displacements; fades.
    """

    rates: Floats
    count: float

    def joined(self, moved: Floats, radius: float, elapsed: float) -> Stride:
        """Add a displacement (6,) of a body of some radius to what is remembered.

        A body whose features shift by some length may also turn them by half of it, and
        the other way round: a turn is not unlikely for not having been seen so far.
        """
        lever = np.repeat([1.0, radius], 3)
        shares = _per_kind_mean((moved * lever) ** 2)
        other = np.roll(shares, 3)
        rate = np.maximum(shares, _LEAST_SHARE * other) / lever**2 / elapsed
        return Stride(_RECALL * self.rates + rate, _RECALL * self.count + 1)

    def variance(self, elapsed: float) -> Floats:
        """Variance (6,) of the displacement in a time.

        Steps that follow each other are alike, so that errors of prediction add up: it is wider
        than the mean square.
        """
        return np.asarray(_PERSISTENCE * self.rates / self.count * elapsed)


@dataclass(frozen=True)
class Track:
    """What is known between two frames.

    Attributes
    ----------
    branches : tuple of Branch
        Best first; empty where nothing is known.
    frame : int or None
        The last frame with a pose; None before the first.
    time_s : float or None
        Its time.
    misses : int
        Frames since then.
    noise : Noise
        Residuals so far.
    stride : Stride or None
        None before two uncertain poses.
    loose : mapping of str to (float, float)
        Of a body that looks like itself a step aside, by sensor, in the last frame with a pose:
        features missed, and detections around the body that belonged to none.
    """

    branches: tuple[Branch, ...] = ()
    frame: int | None = None
    time_s: float | None = None
    misses: int = 0
    noise: Noise = field(default_factory=Noise)
    stride: Stride | None = None
    loose: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def missed(self) -> Track:
        """The track after a frame without a pose."""
        return replace(self, misses=self.misses + 1)


@dataclass(frozen=True)
class Prediction:
    """Where a branch expects the body in a frame."""

    T_world_object: Floats
    uncertainty: Floats
    weight: float
    is_prior: bool = False


def predict(track: Track, body: Body, frame: int, time_s: float | None) -> list[Prediction]:
    """Where the branches of a track expect the body.

    The longer nothing was seen, the wider; velocities are believed for a few frames only.
    """
    elapsed = elapsed_since(track, frame, time_s)
    widening = min(_WIDENING**track.misses, _WIDEST * (1 + track.misses / 10))
    predictions = []
    for branch in track.branches:
        T = branch.T_world_object
        if branch.spread is not None:
            moved = _stride_of(track, body, elapsed).variance(elapsed)
            u = np.sqrt(branch.spread**2 + moved)
            predictions.append(Prediction(T, u, branch.weight, is_prior=True))
            continue
        if branch.velocity is not None and track.misses <= COASTING:
            T = perturb(T, branch.velocity * elapsed)
        predictions.append(Prediction(T, branch.uncertainty * widening, branch.weight))
    return predictions


def prior_of(
    T_world_object: Floats,
    predictions: Sequence[Prediction],
    body: Body,
    free: NDArray[np.bool_],
    misses: int,
) -> Prior:
    """Density of a pose before its frame: the predictions, or now and then anywhere."""
    anywhere = flat_prior(body, free)
    if not predictions:
        return anywhere
    surprise = min(_SURPRISE * (1 + misses), 1.0)
    terms = [np.log(surprise) + anywhere.log_density]
    for prediction in predictions:
        u = prediction.uncertainty[free]
        twist = twist_between(
            prediction.T_world_object,
            nearest_alike(T_world_object, body, prediction.T_world_object),
        )
        scaled = twist[free] / u
        log_density = -0.5 * scaled @ scaled - np.log(u * np.sqrt(2 * np.pi)).sum()
        weight = max((1 - surprise) * prediction.weight, 1e-12)
        terms.append(np.log(weight) + log_density)
    return Prior(float(np.logaddexp.reduce(terms)), anywhere.spread)


def nearest_alike(T_world_object: Floats, body: Body, T_reference: Floats | None) -> Floats:
    """Of the poses that look the same, the one turned least against a reference.

    Without a reference it is the one turned least against the world.
    """
    if len(body.symmetries) == 1:
        return T_world_object
    alike = T_world_object @ body.symmetries
    reference = np.eye(4) if T_reference is None else T_reference
    angles = rotation_angle_deg(np.broadcast_to(reference, alike.shape), alike)
    return np.asarray(alike[int(np.argmin(angles))])


class Found(NamedTuple):
    """A pose of a frame, its belief among its rivals, and its spread if that is to be a prior."""

    T_world_object: Floats
    weight: float
    spread: Floats | None = None


def follow(
    track: Track,
    body: Body,
    found: Sequence[Found],
    frame: int,
    time_s: float | None,
    noise: Noise,
    loose: Mapping[str, tuple[float, float]],
) -> Track:
    """The track after a frame with poses.

    Parameters
    ----------
    track : Track
        Before the frame.
    body : Body
    found : sequence of Found
        Best first.
    frame, time_s
        Of the frame.
    noise : Noise
        Residuals so far.
    loose
        Of the best pose, as `Track` has it.
    """
    elapsed = elapsed_since(track, frame, time_s)
    branches: list[Branch] = []
    stride = track.stride
    for T, weight, spread in found:
        velocity, steady, uncertainty = None, None, _unsteady(body)
        parent = _parent(track, T, body)
        if spread is not None and parent is not None and elapsed > 0:
            if not branches and track.frame is not None:
                moved = twist_between(parent.T_world_object, T)
                stride = _stride_of(track, body, elapsed).joined(moved, body.radius, elapsed)
        elif parent is not None and track.frame is not None and elapsed > 0:
            moved = twist_between(parent.T_world_object, T)
            if track.misses <= COASTING:
                velocity = moved / elapsed
                steady = velocity if parent.velocity is None else (velocity + parent.velocity) / 2
                change = moved - (0 if parent.velocity is None else parent.velocity * elapsed)
                half = np.abs(change) if parent.velocity is not None else np.abs(moved) / 2
                uncertainty = np.maximum(_per_kind(half), _steady(body))
        branches.append(Branch(T, weight, velocity, uncertainty, spread, steady))
    return Track(tuple(branches), frame, time_s, 0, noise, stride, loose)


def _stride_of(track: Track, body: Body, elapsed: float) -> Stride:
    """What was learnt of the motion, or a guess that is wide enough for most."""
    if track.stride is not None:
        return track.stride
    turn = np.radians(_UNKNOWN_ROTATION_DEG)
    unknown = np.repeat([_UNKNOWN_DISTANCE_SHARE * body.radius, turn], 3)
    return Stride(_GUESSED * unknown**2 / max(elapsed, 1e-9), _GUESSED)


def elapsed_since(track: Track, frame: int, time_s: float | None) -> float:
    """Time since the last pose: seconds where both frames have times, else frames."""
    if time_s is not None and track.time_s is not None:
        return time_s - track.time_s
    return float(frame - (track.frame or 0))


def _parent(track: Track, T: Floats, body: Body) -> Branch | None:
    """The branch that a pose goes on from: the nearest."""
    if not track.branches:
        return None
    away = [
        np.linalg.norm(twist_between(branch.T_world_object, T) / np.repeat([body.radius, 1.0], 3))
        for branch in track.branches
    ]
    return track.branches[int(np.argmin(away))]


def _per_kind_mean(squares: Floats) -> Floats:
    """The mean of the lengths and of the angles that are not zero, for all directions alike."""
    parts = [part.sum() / max(np.count_nonzero(part), 1) for part in (squares[:3], squares[3:])]
    return np.repeat(parts, 3)


def _per_kind(twist: Floats) -> Floats:
    """The largest of the lengths and the largest of the angles, for all directions alike."""
    return np.repeat([np.abs(twist[:3]).max(), np.abs(twist[3:]).max()], 3)


def _steady(body: Body) -> Floats:
    turn = np.radians(_STEADY_ROTATION_DEG)
    return np.repeat([_STEADY_DISTANCE_SHARE * body.radius, turn], 3)


def _unsteady(body: Body) -> Floats:
    """Uncertainty of the next pose where no velocity is known yet."""
    return 5 * _steady(body)

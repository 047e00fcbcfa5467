"""Study systems side by side: accuracy, the noise at which one equals another, and advice.

Systems are judged at poses in a box, turned around a first pose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from mixpose.body import Body, LookAlike, congruent_parts
from mixpose.checking import noise_of
from mixpose.design import advice
from mixpose.design.advice import MarkerMove, NewSensor
from mixpose.design.confirmation import Confirmation, confirm
from mixpose.design.prediction import Plan, Summary, at_tip, plan_of, pooled, predict, summarise
from mixpose.errors import SessionError
from mixpose.executing import Executor
from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.session import Session
from mixpose.simulation.central_pose import central_pose, pivot_of

SHARE_OF_RADIUS = 0.1
"""Bodies whose markers are congruent to this share of the smaller radius are reported: two of a
motion capture recording that are taken for each other, rigid to 2 to 5 mm, have 0.08."""

_ALL_TURNS = 180.0
_TURN_AROUND_START = 20.0  # degrees, if the session gives the body's orientation


@dataclass(frozen=True)
class Request:
    """Options of a study."""

    poses: Floats  # (P, 4, 4)
    tip: Floats | None = None  # (3,): in the object's frame; None for its origin
    # standard deviations by system (None: all) and sensor
    noises: Mapping[tuple[int | None, str], float] = field(default_factory=dict)
    runs: int = 0  # frames to simulate for each system; 0 for none
    seed: int = 0
    tolerance: float | None = None  # of congruent markers; None for a share of the radius

    @property
    def point(self) -> Floats:
        """Return the tip (3,), or the origin."""
        return np.zeros(3) if self.tip is None else self.tip

    def error_of(self, plan: Plan) -> float:
        """Return the error of the point with a plan, pooled over the poses."""
        variances = np.einsum("pii->p", at_tip(predict(plan, self.poses), self.point))
        return pooled(np.sqrt(variances))


@dataclass(frozen=True)
class Equal:
    """The noise with which a system is as accurate as the first system."""

    factor: float | None  # on all its noises; None if no factor suffices
    noises: tuple[float, ...]  # the noises with that factor
    wanted: float  # error of the first system
    confirmation: Confirmation | None = None  # of the system with these noises


@dataclass(frozen=True)
class System:
    """A system of a study."""

    name: str
    session: Session
    plan: Plan
    summary: Summary
    error: float  # as of `Request.error_of`
    weighed: float  # the same with sigmas in proportion to the noise of features
    confirmation: Confirmation | None = None
    equal: Equal | None = None
    move: MarkerMove | None = None
    new: NewSensor | None = None


@dataclass(frozen=True)
class Study:
    """Systems, and congruent parts of their bodies."""

    request: Request
    unit: str
    systems: tuple[System, ...]
    congruences: tuple[LookAlike, ...]


def study(
    named: Sequence[tuple[str, Session]],
    request: Request,
    say: Callable[[str], None] = lambda text: None,
    executor: Executor | None = None,
) -> Study:
    """Study systems of one unit and compare them with the first.

    Their cameras have resolutions.  `say` is called with each step; an executor estimates the
    simulated frames.
    """
    systems: list[System] = []
    for k, (name, session) in enumerate(named):
        say(f"{name}: prediction and advice")
        noises = {s: v for (index, s), v in request.noises.items() if index in (None, k)}
        systems.append(_system(name, session, plan_of(session, noises), request))

    def confirmed(system: System, plan: Plan, what: str = "") -> Confirmation | None:
        """Simulate a system with a plan, if that is asked for, at poses that are determined."""
        if not request.runs:
            return None
        say(f"{system.name}: {request.runs} simulated frames{what}")
        determined = np.setdiff1d(np.arange(len(request.poses)), system.summary.undetermined)
        if not len(determined):
            return None
        poses, tip, seed = request.poses[determined], request.point, request.seed
        arguments = system.session, plan, poses, request.runs
        return confirm(*arguments, tip=tip, seed=seed, executor=executor)

    for k, system in enumerate(systems):
        confirmation = confirmed(system, system.plan)
        equal = _equal(system, systems[0], request, confirmed) if k else None
        systems[k] = replace(system, confirmation=confirmation, equal=equal)
    bodies = [body_setup.body for _, session in named for body_setup in session.objects]
    congruences = tuple(_congruences(bodies, request))
    return Study(request, named[0][1].unit, tuple(systems), congruences)


def _system(name: str, session: Session, plan: Plan, request: Request) -> System:
    error_of = request.error_of
    prediction = predict(plan, request.poses)
    setups = []  # with `sigma` in proportion to the noise, by which look-alikes are judged
    for setup, noise in zip(session.sensors, plan.noises, strict=True):
        sigma = setup.extract.sigma * noise / noise_of(setup)
        setups.append(replace(setup, extract=replace(setup.extract, sigma=sigma)))
    summary = summarise(plan, tuple(setups), prediction, request.point)
    middle = (request.poses[:, :3, :3] @ plan.body.means.mean(axis=0)).mean(axis=0)
    middle = middle + request.poses[:, :3, 3].mean(axis=0)
    return System(
        name=name,
        session=session,
        plan=plan,
        summary=summary,
        error=error_of(plan),
        weighed=error_of(replace(plan, sigmas=plan.noises)),
        move=advice.best_marker_move(plan, error_of),
        new=advice.best_new_sensor(plan, error_of, middle),
    )


def _equal(
    system: System,
    first: System,
    request: Request,
    confirmed: Callable[[System, Plan, str], Confirmation | None],
) -> Equal:
    factor = advice.noise_to_equal(system.plan, first.error, request.error_of)
    if factor is None:
        return Equal(None, (), first.error)
    plan = advice.scaled(system.plan, factor)
    confirmation = confirmed(system, plan, f" with what equals {first.name}")
    return Equal(factor, plan.noises, first.error, confirmation)


def _congruences(bodies: Sequence[Body], request: Request) -> list[LookAlike]:
    congruences: list[LookAlike] = []
    known: list[Body] = []
    for body in bodies:
        if any(body.name == o.name and np.array_equal(body.means, o.means) for o in known):
            continue
        for other in known:
            share = SHARE_OF_RADIUS * min(body.radius, other.radius)
            tolerance = share if request.tolerance is None else request.tolerance
            congruences += congruent_parts(other, body, tolerance)[:1]
        known.append(body)
    return congruences


def spread_poses(
    session: Session,
    count: int,
    *,
    volume: Floats | None = None,
    turn_deg: float | None = None,
    seed: int = 0,
) -> Floats:
    """Return poses T_world_object (P, 4, 4) spread evenly over a volume; the first is its middle.

    Cameras must have a resolution.  The middle is the session's ``[start]``, or else where its
    sensors look together.  `volume` (3,) are the sides of the box, along the world's axes, that
    contains the body's middle; the default is twice the body's radius.  `turn_deg`, up to 180, is
    the largest angle from the orientation of the middle; the default is 20 around a ``[start]``,
    else 180.  Raises SessionError if no place is in view of a sensor.
    """
    centre = central_pose(session, seed)
    body = session.body
    sides = np.full(3, 2 * body.radius) if volume is None else np.asarray(volume)
    if turn_deg is None:
        turn_deg = _ALL_TURNS if session.start is None else _TURN_AROUND_START
    if not 0 <= turn_deg <= _ALL_TURNS:
        raise SessionError(f"--turn: found {turn_deg:g}; allowed: degrees from 0 to 180")
    drawn = qmc.Halton(6, rng=np.random.default_rng(seed)).random(count)
    pivot = pivot_of(body)
    middle = centre[:3, :3] @ pivot + centre[:3, 3]
    positions = middle + (drawn[:, :3] - 0.5) * sides
    rotations = _turns(drawn[:, 3:], turn_deg) @ centre[:3, :3]
    poses = from_parts(rotations, positions - rotations @ pivot)
    poses[0] = centre
    return poses


def _turns(drawn: Floats, turn_deg: float) -> Floats:
    """Return evenly spread rotations (P, 3, 3) up to an angle, from numbers (P, 3) from 0 to 1."""
    if turn_deg >= _ALL_TURNS:
        u, v, w = drawn[:, 0], 2 * np.pi * drawn[:, 1], 2 * np.pi * drawn[:, 2]
        a, b = np.sqrt(1 - u), np.sqrt(u)
        quaternions = np.array([a * np.sin(v), a * np.cos(v), b * np.sin(w), b * np.cos(w)]).T
        return np.asarray(Rotation.from_quat(quaternions).as_matrix())
    height, around = 2 * drawn[:, 0] - 1, 2 * np.pi * drawn[:, 1]
    across = np.sqrt(1 - height**2)
    axes = np.array([across * np.cos(around), across * np.sin(around), height]).T
    angles = np.radians(turn_deg) * np.cbrt(drawn[:, 2])
    return np.asarray(Rotation.from_rotvec(axes * angles[:, None]).as_matrix())

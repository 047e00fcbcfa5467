"""A calibration from beginning to end: start, adjust, leave out what is bad, look at the rest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mixpose.calibration.adjust import Adjusted, GaugeOf, adjust, moved_by_held
from mixpose.calibration.alone import Hypotheses
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.choice import held_back_with
from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.gauge import Freedom, gauge_rows
from mixpose.calibration.interpolation import neighbours
from mixpose.calibration.latecomers import placed
from mixpose.calibration.matching import clock_of
from mixpose.calibration.residuals import (
    explained_share,
    met_share,
    rms,
    sights_of,
    squared_residuals,
)
from mixpose.calibration.result import Calibration, Residual
from mixpose.calibration.rig import Block, Rig, blocks_of, centre_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.start import Start, searched, start_from_cameras, starts_together, without
from mixpose.calibration.task import Known, Progress, Task, silent
from mixpose.errors import RecordingError
from mixpose.records import Floats
from mixpose.sensors import CalibrationError, RangeSensor
from mixpose.threads import one_blas_thread

_STAGES = 8  # of a calibration, for progress


@one_blas_thread()
def calibrate(
    task: Task,
    rules: CalibrationRules = CalibrationRules(),
    *,
    progress: Progress = silent,
    found: dict[tuple[int, int], Hypotheses] | None = None,
) -> Calibration:
    """Calibrate sensors and body from what the sensors saw.

    Parameters
    ----------
    found : dict or None
        Hypotheses of single cameras that are known from before; new ones are added.

    Raises
    ------
    RecordingError
        If the body is not found in enough frames.
    """
    if task.cameras:
        known = searched(task, rules, progress, {} if found is None else found)
        best = _from_cameras(task, known, rules, progress)
    else:
        starts = starts_together(task, _probed(task, rules, progress), progress)
        best = _best(task, starts, rules, progress)
    if best is None:
        raise RecordingError(
            "calibrate: found the body in no frame; allowed: a recording in which `mixpose "
            "check` finds its features"
        )
    run = best[1]
    off = run.found.noise / task.sigmas
    if (off >= rules.failed).any():
        name = task.rig.names[int(np.argmax(off))]
        raise RecordingError(
            f"calibrate: sensor {name!r}: found residuals of {off.max():.3g} times extract.sigma, "
            "as if by chance; allowed: less than 1.9 times: a session whose sensors stand nearer "
            "to where they are, or a larger extract.sigma where detections err by that much"
        )
    return replace(run.found, residuals=run.residuals())


def _from_cameras(
    task: Task, known: Known, rules: CalibrationRules, progress: Progress
) -> tuple[int, _Run] | None:
    """The run from what cameras know alone, and again without those it misplaced.

    What these know alone may have linked them wrongly; they are placed by the poses that the others
    tell then.
    """
    best = _best(task, [start_from_cameras(task, known, rules)], rules, progress)
    if best is None or task.known is not None:
        return best
    wrong = {s for s in best[1].found.doubtful(rules) if "pose" in task.free.get(s, ())}
    if not wrong or len(wrong) + 1 > len(task.cameras):
        return best
    others = {key: one for key, one in known.items() if key[1] not in wrong}
    again = _best(task, [start_from_cameras(task, others, rules)], rules, progress)
    return max(best, again or best, key=lambda one: float(np.nansum(one[1].found.explained)))


def _probed(task: Task, rules: CalibrationRules, progress: Progress) -> CalibrationRules:
    """Rules with the one blur that suits best, by a few of many frames that are searched singly."""
    few = task.frames[:: -(-len(task.frames) // rules.probes)]
    if task.known is not None or task.fuse or len(few) == len(task.frames):
        return rules
    probe = replace(task, frames=few)
    best = _best(probe, starts_together(probe, rules, progress), rules, progress)
    return rules if best is None else replace(rules, widened=(rules.widened[best[0]],))


def _best(
    task: Task, starts: Iterable[Start], rules: CalibrationRules, progress: Progress
) -> tuple[int, _Run] | None:
    """Number and run of the first start that tells features apart, else of the best."""
    best: tuple[tuple[bool, float], int, _Run] | None = None
    for number, start in enumerate(starts):
        if not len(start.poses):
            continue
        one = _Run(task, start, rules, progress)
        fits = bool((one.found.noise < rules.failed * task.sigmas).all())
        worth = (fits, one.found.certainty)
        if best is None or worth > best[0]:
            best = (worth, number, one)
        if worth >= (True, rules.certain):
            break
    return None if best is None else best[1:]


@dataclass(frozen=True, eq=False)
class _Part:
    """Some of the frames with their poses."""

    frames: tuple[SeenFrame, ...]
    poses: Floats

    def only(self, mask: NDArray[np.bool_]) -> _Part:
        kept = np.flatnonzero(mask)
        return _Part(tuple(self.frames[k] for k in kept), self.poses[kept])


def _left_out(part: _Part, good: NDArray[np.bool_]) -> list[int]:
    """Numbers of bad frames; none where all are: then no sensor was placed yet."""
    return [f.number for f, ok in zip(part.frames, good, strict=True) if not ok and good.any()]


class _Run:
    """One calibration from a start.

    Attributes
    ----------
    found : Calibration
        Without residuals.
    """

    def __init__(
        self, task: Task, start: Start, rules: CalibrationRules, progress: Progress
    ) -> None:
        self._task, self._start, self._rules, self._progress = task, start, rules, progress
        self._known = task.known is not None
        self._pose_free = task.pose_free & (not self._known)
        times = [f.time_s for f in start.frames if f.time_s is not None]
        steps = np.diff(np.unique(times)) if len(times) > 1 else np.ones(1)
        self._interval = float(np.median(steps))
        self._asked = task.free
        self._late: dict[int, Floats] = {}
        free = {s: kinds for s, kinds in task.free.items() if s not in start.unlinked}
        self._task = replace(task, free=free)
        self._blocks = self._laid_out()
        self.found = self._result()

    def _laid_out(self) -> tuple[Block, ...]:
        return blocks_of(
            self._start.rig,
            self._task.free,
            body=self._task.body_free,
            length=_size_of(self._start.rig, self._start.poses),
            interval=self._interval,
        )

    def _result(self) -> Calibration:
        """The calibration, but for its residuals."""
        rules, part = self._rules, _Part(self._start.frames, self._start.poses)
        self._progress("adjusting all sensors together", 0, _STAGES)
        adjusted = self._adjusted(part, self._start.rig, None)
        good = met_share(adjusted, part.frames, self._task) > rules.least_met
        bad = _left_out(part, good)
        part = replace(part, poses=adjusted.poses)
        part = part.only(good) if bad else part
        # from wider blurs, as features that crowd let the noise that is learnt first be too small
        self._progress("adjusting again, without bad frames", 1, _STAGES)
        adjusted = self._adjusted(part, adjusted.rig, self._again(adjusted))
        part = replace(part, poses=adjusted.poses)
        self._place_latecomers(part, adjusted)
        if self._late:
            self._progress("adjusting with cameras that came late", 2, _STAGES)
            part, rig = self._completed(part, adjusted.rig)
            adjusted = self._adjusted(part, rig, self._again(adjusted))
            part = replace(part, poses=adjusted.poses)
        self._part, self._best = part, adjusted
        return self._told(part, adjusted, bad)

    def residuals(self) -> dict[int, Residual]:
        """Residuals before and after, and of every frame by a rig that was adjusted without it.

        Matches are the same in all three, and poses are fitted to each rig.
        """
        part, best = self._part, self._best
        folds = held_back_with(len(part.poses), self._rules, runs=self._task.times_matter)
        sensors = range(len(self._task.rig.sensors))
        bundle = self._bundle(part, ())
        before = squared_residuals(bundle, self._task.rig, best)
        after = squared_residuals(bundle, best.rig, best)
        held: list[list[Floats]] = [[] for _ in sensors]
        for fold in np.unique(folds[folds >= 0]):
            self._progress("holding back a part of the frames", 3 + int(fold), _STAGES)
            fit = self._adjusted(part.only(folds != fold), best.rig, self._again(best))
            lost = {
                block.sensor
                for block in self._blocks
                if (fit.undetermined & ~best.undetermined)[block.place].any()
            }
            found = squared_residuals(bundle, fit.rig, best)
            for s in sensors:
                if s not in lost:
                    held[s].append(found[s][folds[best.weighted[s][0].frame] == fold])
        return {s: Residual(rms([before[s]]), rms([after[s]]), rms(held[s])) for s in sensors}

    def _again(self, adjusted: Adjusted) -> Floats:
        """Blurs to begin with near what was adjusted before."""
        return 2 * self._rules.blur * adjusted.noise

    def _place_latecomers(self, training: _Part, adjusted: Adjusted) -> None:
        """Place cameras that could not be linked by what they see alone."""
        task, start = self._task, self._start
        if not start.unlinked:
            return
        numbers = {frame.number: frame for frame in task.frames}
        frames = tuple(numbers[frame.number] for frame in training.frames)
        linked = [s for s in task.cameras if s not in start.unlinked]
        for sensor in start.unlinked:
            T = placed(
                task,
                adjusted.rig,
                sensor,
                linked,
                frames,
                adjusted.poses,
                adjusted.noise,
                self._rules,
            )
            if T is not None:
                self._late[sensor] = T

    def _completed(self, part: _Part, rig: Rig) -> tuple[_Part, Rig]:
        """Frames with what the cameras that came late saw, and the rig with them."""
        task = self._task
        if not self._late:
            return part, rig
        rest = {s for s in self._start.unlinked if s not in self._late}
        numbers = {frame.number: frame for frame in task.frames}
        frames = tuple(without(numbers[f.number], rest) for f in part.frames)
        for sensor, T in self._late.items():
            rig = rig.placed(sensor, T)
        free = {s: kinds for s, kinds in self._asked.items() if s not in rest}
        self._task = replace(task, free=free)
        self._blocks = self._laid_out()
        return _Part(frames, part.poses), rig

    def _bundle(self, part: _Part, blocks: tuple[Block, ...]) -> Bundle:
        near = neighbours([f.time_s for f in part.frames], self._rules.gap)
        clock = clock_of(part.frames, near, len(self._task.rig.sensors))
        errors = self._task.errors if blocks else {}
        return Bundle(part.frames, clock, blocks, self._pose_free, self._rules.undetermined, errors)

    def _moved_by_biases(self, part: _Part, adjusted: Adjusted) -> Floats:
        """What biases as large as σ_ε would move (G,), of sensors of which nothing is stated."""
        task = self._task
        errors = {
            s: CalibrationError(range_bias=float(task.sigmas[s]))
            for s, eye in enumerate(task.rig.sensors)
            if isinstance(eye, RangeSensor) and s not in task.errors
            if "range_bias" not in task.free.get(s, ())
        }
        if not errors:
            return np.zeros(sum(len(block.names) for block in self._blocks))
        bundle = replace(self._bundle(part, self._blocks), errors=errors)
        return moved_by_held(bundle, adjusted, self._gauge(part.poses), self._rules)

    def _gauge(self, poses: Floats) -> GaugeOf:
        freedom = Freedom(self._pose_free, poses)
        return lambda rig: gauge_rows(rig, self._blocks, freedom, self._task.length)[0]

    def _adjusted(self, part: _Part, rig: Rig, blurs: Floats | None) -> Adjusted:
        bundle = self._bundle(part, self._blocks)
        gauge = self._gauge(part.poses)
        return adjust(bundle, rig, part.poses, gauge, self._task.sigmas, self._rules, blurs=blurs)

    def _told(
        self,
        part: _Part,
        adjusted: Adjusted,
        bad: list[int],
    ) -> Calibration:
        task = self._task
        freedom = Freedom(self._pose_free, part.poses)
        _, gauge = gauge_rows(adjusted.rig, self._blocks, freedom, task.length)
        deviations, refused = _determined(self._blocks, adjusted, task.rig.names)
        numbers = [f.number for f in part.frames]
        return Calibration(
            before=task.rig,
            after=adjusted.rig,
            blocks=self._blocks,
            deviations=deviations,
            covariance=adjusted.covariance,
            refused=refused,
            gauge=gauge,
            through=self._start.through,
            unlinked=tuple(s for s in self._start.unlinked if s not in self._late),
            used=tuple(numbers),
            bad=tuple(sorted(bad)),
            recorded=len(task.frames),
            residuals={},
            noise=adjusted.noise,
            inflation=adjusted.inflation,
            certainty=adjusted.certainty,
            moved_by_biases=self._moved_by_biases(part, adjusted),
            explained=explained_share(adjusted, part.frames, task),
            sights=sights_of(adjusted, numbers),
            poses=dict(zip(numbers, adjusted.poses, strict=True)),
            frames=part.frames,
        )


def _size_of(rig: Rig, poses: Floats) -> float:
    """Median distance from sensors to the body, or from sensor to sensor if that is more."""
    centres = np.array([centre_of(s) for s in rig.sensors])
    places = poses[:, :3, 3] + poses[:, :3, :3] @ rig.points.mean(axis=0)
    away = np.linalg.norm(places[:, None] - centres[None], axis=2)
    return float(max(np.median(away), 1e-9))


def _determined(
    blocks: Sequence[Block], adjusted: Adjusted, names: Sequence[str]
) -> tuple[Floats, tuple[str, ...]]:
    """Standard deviations, infinite where not determined, and what is refused in words."""
    deviations = np.sqrt(np.maximum(np.diag(adjusted.covariance), 0.0))
    labels = [
        f"{'body' if b.sensor is None else names[b.sensor]}:{b.kind} {name}"
        for b in blocks
        for name in b.names
    ]
    said = []
    for direction in adjusted.unknown.T:
        strongest = np.argsort(-np.abs(direction), kind="stable")[:3]
        parts = [labels[k] for k in strongest if abs(direction[k]) > 0.2]
        said.append(" with ".join(parts))
    deviations[adjusted.undetermined] = np.inf
    return deviations, tuple(said)

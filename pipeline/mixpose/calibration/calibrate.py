"""A calibration from beginning to end: start, adjust, leave out what is bad, look at the rest."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from mixpose.calibration import result
from mixpose.calibration.adjust import Adjusted, adjust, fitted, moved_by_held
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.gauge import gauge_rows
from mixpose.calibration.latecomers import placed
from mixpose.calibration.profile import Contradiction, contradiction, profiled
from mixpose.calibration.recorded import held_back_with
from mixpose.calibration.rig import Block, Kind, Rig, State, blocks_of, centre_of, kinds_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.searching import posed, searched
from mixpose.calibration.start import Start, start_from_cameras, starts_together
from mixpose.calibration.task import Known, Progress, Task, silent
from mixpose.errors import RecordingError
from mixpose.records import Floats
from mixpose.sensors import CalibrationError, CloudSensor
from mixpose.threads import one_blas_thread

_STAGES = 8  # of a calibration, for progress


@one_blas_thread()
def calibrate(
    task: Task,
    rules: CalibrationRules = CalibrationRules(),
    *,
    progress: Progress = silent,
    found: Known | None = None,
) -> result.Calibration:
    """Calibrate sensors and body from what the sensors saw.

    `found` are hypotheses of single cameras that are known from before; new ones are added.
    Raises a RecordingError if the body is not found in enough frames.
    """
    if task.cameras:
        best = _as_it_stands(task, rules, progress)
        if best is None:
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
    off = best.found.noise / task.sigmas
    if (off >= rules.failed).any():
        name = task.rig.names[int(np.argmax(off))]
        raise RecordingError(
            f"calibrate: sensor {name!r}: found residuals of {off.max():.3g} times extract.sigma, "
            "as if by chance; allowed: less than 1.9 times: a session whose sensors stand nearer "
            "to where they are, or a larger extract.sigma where detections err by that much"
        )
    told = best.profiled()
    return replace(told, residuals=best.residuals(), contradicted=best.contradicted())


def _as_it_stands(task: Task, rules: CalibrationRules, progress: Progress) -> _Run | None:
    """The run from where the session has all cameras; None where that leaves any unexplained."""
    # together they know the body among others that each alone may take for it
    if task.known is not None or task.times_matter or len(task.cameras) < 2 or not task.frames:
        return None
    few = _few(task, rules)
    if sum(one.is_sure for one in posed(few)) <= len(few.frames) / 2:
        return None
    start = Start.of(task.rig, posed(task, progress=progress))
    best = _best(task, [start], rules, progress)
    wrong = () if best is None else best.found.doubtful(rules)
    if any("pose" not in task.free.get(s, ()) for s in wrong):  # one that is held stays
        return None
    if wrong:  # they are placed by what the others know
        frames = tuple(frame.without(wrong) for frame in start.frames)
        best = _best(task, [replace(start, frames=frames, unlinked=wrong)], rules, progress)
    if best is None or not (best.fits and best.found.are_linked) or best.found.doubtful(rules):
        return None
    return best


def _few(task: Task, rules: CalibrationRules) -> Task:
    """The task with a few of its frames, spread evenly."""
    return replace(task, frames=task.frames[:: -(-len(task.frames) // rules.probes)])


def _from_cameras(
    task: Task, known: Known, rules: CalibrationRules, progress: Progress
) -> _Run | None:
    """The run from what cameras know alone, and again without those it misplaced."""
    # what these know alone may have linked them wrongly; they are placed by the poses that the
    # others tell then
    best = _best(task, [start_from_cameras(task, known, rules)], rules, progress)
    if best is None or task.known is not None:
        return best
    wrong = {s for s in best.found.doubtful(rules) if "pose" in task.free.get(s, ())}
    if not wrong or len(wrong) + 1 > len(task.cameras):
        return best
    others = {key: one for key, one in known.items() if key[1] not in wrong}
    again = _best(task, [start_from_cameras(task, others, rules)], rules, progress)
    return max(best, again or best, key=lambda one: float(np.nansum(one.found.explained)))


def _probed(task: Task, rules: CalibrationRules, progress: Progress) -> CalibrationRules:
    """Rules with the one blur that suits best, by a few of many frames that are searched singly."""
    probe = _few(task, rules)
    if task.known is not None or task.fuse or len(probe.frames) == len(task.frames):
        return rules
    best = _best(probe, starts_together(probe, rules, progress), rules, progress)
    return rules if best is None else replace(rules, widened=(best.start.factor,))


def _best(
    task: Task, starts: Iterable[Start], rules: CalibrationRules, progress: Progress
) -> _Run | None:
    """The run of the first start that tells features apart, else the best."""
    best: _Run | None = None
    for start in starts:
        if not len(start.frames):
            continue
        one = _Run(task, start, rules, progress)
        if best is None or one.worth > best.worth:
            best = one
        if one.worth >= (True, rules.certain):
            break
    return best


class _Run:
    """One calibration from a start; what it `found` is without what only the best is asked."""

    def __init__(
        self, task: Task, start: Start, rules: CalibrationRules, progress: Progress
    ) -> None:
        self.start = start
        self._asked, self._rules, self._progress = task, rules, progress
        self._pose_free = task.pose_free & (task.known is None)
        times = [f.time_s for f in start.frames if f.time_s is not None]
        steps = np.diff(np.unique(times)) if len(times) > 1 else np.ones(1)
        self._interval = float(np.median(steps))
        self._lay_out(start.unlinked)
        self.found = self._result()

    @property
    def fits(self) -> bool:
        """Whether residuals are smaller than chance leaves them."""
        return bool((self.found.noise < self._rules.failed * self._asked.sigmas).all())

    @property
    def worth(self) -> tuple[bool, float]:
        """By which the best of several is chosen."""
        return self.fits, self.found.certainty

    def _lay_out(self, unlinked: Collection[int]) -> None:
        """Seek what is free of sensors that are linked by now."""
        self._unlinked = tuple(unlinked)
        free = {s: kinds for s, kinds in self._asked.free.items() if s not in unlinked}
        self._task = replace(self._asked, free=free)
        rig, poses = self.start.state
        # median distance from sensors to the body
        centres = np.array([centre_of(s) for s in rig.sensors])
        places = poses[:, :3, 3] + poses[:, :3, :3] @ rig.points.mean(axis=0)
        away = np.linalg.norm(places[:, None] - centres[None], axis=2)
        body, self._length = self._task.body_free, float(max(np.median(away), 1e-9))
        self._blocks = blocks_of(rig, free, body=body, length=self._length, interval=self._interval)

    def _result(self) -> result.Calibration:
        """The calibration, but for its residuals."""
        part = self.start
        self._progress("adjusting all sensors together", 0, _STAGES)
        part, adjusted = self._adjusted(part)
        good = result.met_share(adjusted, part.frames, self._task) > self._rules.least_met
        bad: list[int] = []
        if good.any():  # else no sensor was placed yet
            bad = [f.number for f, ok in zip(part.frames, good, strict=True) if not ok]
            part = part.only(good)
        # from wider blurs, as features that crowd let the noise that is learnt first be too small
        self._progress("adjusting again, without bad frames", 1, _STAGES)
        part, adjusted = self._adjusted(part, adjusted.noise)
        whole = self._with_latecomers(part, adjusted.noise)
        if whole is not part:
            self._progress("adjusting with cameras that came late", 2, _STAGES)
            part, adjusted = self._adjusted(whole, adjusted.noise)
        self._part, self._best = part, adjusted
        return self._told(part, adjusted, bad)

    def profiled(self) -> result.Calibration:
        """The same, with deviations by how much worse the fit gets."""
        self._best = profiled(self._bundle(self._part), self._best)
        best = self._best
        return replace(self.found, deviations=best.deviations, covariance=best.covariance)

    def residuals(self) -> dict[int, result.Residual]:
        """Residuals before and after, and of every frame by a rig that was adjusted without it.

        Matches are the same in all three, and poses are fitted to each rig.
        """
        part, best = self._part, self._best
        folds = held_back_with(len(part.frames), self._rules, runs=self._task.times_matter)
        sensors = range(len(self._task.rig.sensors))
        # without parameters of the rig, so that all rigs are held to the same
        bundle = replace(self._bundle(part), blocks=(), gauge=lambda _: np.zeros((0, 0)), errors={})
        _, before = fitted(bundle, self._task.rig, best)
        _, after = fitted(bundle, best.state.rig, best)
        held: list[list[Floats]] = [[] for _ in sensors]
        for fold in np.unique(folds[folds >= 0]):
            self._progress("holding back a part of the frames", 3 + int(fold), _STAGES)
            _, fit = self._adjusted(part.only(folds != fold), best.noise)
            lost = {
                block.sensor
                for block in self._blocks
                if (fit.undetermined & ~best.undetermined)[block.place].any()
            }
            _, found = fitted(bundle, fit.state.rig, best)
            for s in sensors:
                if s not in lost:
                    held[s].append(found[s][folds[best.weighted[s][0].pairs.frame] == fold])
        return {
            s: result.Residual(result.rms([before[s]]), result.rms([after[s]]), result.rms(held[s]))
            for s in sensors
        }

    def contradicted(self) -> Contradiction | None:
        """What of all that is held the recording contradicts most."""
        sizes = {"length": self._length, "interval": self._interval}
        return contradiction(self._bundle(self._part), self._best, **sizes)

    def _with_latecomers(self, part: Start, noise: Floats) -> Start:
        """The part with cameras that could not be linked by what they see, placed by its poses."""
        numbers = {frame.number: frame for frame in self._task.frames}
        frames = tuple(numbers[frame.number] for frame in part.frames)  # with all that was seen
        linked = [s for s in self._task.cameras if s not in self._unlinked]
        rig, left = part.state.rig, list[int]()
        for s in self._unlinked:
            T = None
            if not isinstance(rig.sensors[s], CloudSensor):  # which has no lines of sight
                T = placed(self._task, part.state, s, linked, frames, noise, self._rules)
            if T is None:
                left.append(s)
            else:
                rig = rig.placed(s, T)
        if rig is part.state.rig:
            return part
        self._lay_out(left)
        frames = tuple(frame.without(left) for frame in frames)
        return replace(part, frames=frames, state=part.state._replace(rig=rig))

    def _bundle(self, part: Start) -> Bundle:
        task = self._task

        def gauge(rig: Rig) -> Floats:
            return self._gauge(part.state._replace(rig=rig))[0]

        return Bundle(
            part.frames, self._blocks, self._pose_free, gauge, task.sigmas, self._rules, task.errors
        )

    def _gauge(self, state: State) -> tuple[Floats, tuple[str, ...]]:
        return gauge_rows(state, self._blocks, self._pose_free, self._task.length)

    def _adjusted(self, part: Start, noise: Floats | None = None) -> tuple[Start, Adjusted]:
        """A part adjusted, from narrow blurs where the noise is known from before."""
        blurs = None if noise is None else 2 * self._rules.blur * noise
        found = adjust(self._bundle(part), part.state, blurs=blurs)
        return replace(part, state=found.state), found

    def _moved_by(self, kind: Kind, part: Start, adjusted: Adjusted) -> Floats:
        """What errors of a kind would move (G,), of sensors of which it is held and not stated."""
        task, lens = self._task, result.HELD_LENS
        errors = {
            s: lens if kind == "focal" else CalibrationError(range_bias=float(task.sigmas[s]))
            for s, eye in enumerate(task.rig.sensors)
            if kind in kinds_of(eye) and kind not in task.free.get(s, ()) and s not in task.errors
        }
        if not errors:
            return np.zeros(sum(len(block.names) for block in self._blocks))
        return moved_by_held(replace(self._bundle(part), errors=errors), adjusted)

    def _told(self, part: Start, adjusted: Adjusted, bad: list[int]) -> result.Calibration:
        task, rig = self._task, adjusted.state.rig
        numbers = [f.number for f in part.frames]
        return result.Calibration(
            before=task.rig,
            after=rig,
            blocks=self._blocks,
            deviations=adjusted.deviations,
            covariance=adjusted.covariance,
            refused=_refused(self._blocks, adjusted, task.rig.names),
            gauge=self._gauge(part.state)[1],
            through=self.start.through,
            unlinked=self._unlinked,
            used=tuple(numbers),
            bad=tuple(sorted(bad)),
            recorded=len(task.frames),
            residuals={},
            noise=adjusted.noise,
            inflation=adjusted.inflation,
            certainty=adjusted.certainty,
            moved_by_biases=self._moved_by("range_bias", part, adjusted),
            moved_by_lenses=self._moved_by("focal", part, adjusted),
            explained=result.explained_share(adjusted, part.frames, task),
            sights=result.sights_of(adjusted, numbers),
            poses=dict(zip(numbers, adjusted.state.poses, strict=True)),
        )


def _refused(blocks: Sequence[Block], adjusted: Adjusted, names: Sequence[str]) -> tuple[str, ...]:
    """Directions that are not determined, in words."""
    labels = [
        f"{'body' if b.sensor is None else names[b.sensor]}:{b.kind} {name}"
        for b in blocks
        for name in b.names
    ]
    said = []
    for direction in adjusted.unknown.T:
        strongest = np.argsort(-np.abs(direction), kind="stable")[:3]
        said.append(" with ".join(labels[k] for k in strongest if abs(direction[k]) > 0.2))
    return tuple(said)

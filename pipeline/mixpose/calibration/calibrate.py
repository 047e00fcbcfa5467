"""A calibration from beginning to end: start, adjust, leave out bad frames, judge the result."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from mixpose.calibration import result
from mixpose.calibration.adjust import Adjusted, adjust, covariance_by_held, fit_pairs
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.gauge import gauge_rows
from mixpose.calibration.latecomers import place_camera
from mixpose.calibration.profile import Contradiction, find_contradiction, with_profiled_lenses
from mixpose.calibration.recorded import folds_of
from mixpose.calibration.rig import Block, Kind, Rig, State, blocks_of, centre_of, kinds_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.searching import posed_frames, search_cameras
from mixpose.calibration.start import Start, start_from_cameras, starts_together
from mixpose.calibration.task import Known, Progress, SeenFrame, Task, silent
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
    """Calibrate sensors and body from the detections of a recording.

    `found` are hypotheses of single cameras from an earlier run; new ones are added to it.
    Raises a RecordingError if the body is not found in enough frames.
    """
    if task.cameras:
        run = _run_from_session(task, rules, progress)
        if run is None:
            known = search_cameras(task, rules, progress, {} if found is None else found)
            run = _run_from_cameras(task, known, rules, progress)
    else:
        starts = starts_together(task, _with_best_blur(task, rules, progress), progress)
        run = _best_run(task, starts, rules, progress)
    if run is None:
        raise RecordingError(
            "calibrate: found the body in no frame; allowed: a recording in which `mixpose "
            "check` finds its features"
        )
    ratio = run.calibration.noise / task.sigmas
    if (ratio >= rules.failed).any():
        name, worst = task.rig.names[int(np.argmax(ratio))], ratio.max()
        raise RecordingError(
            f"calibrate: sensor {name!r}: found residuals of {worst:.3g} times extract.sigma, "
            "as if by chance; allowed: less than 1.9 times: a session whose sensors stand nearer "
            "to where they are, or a larger extract.sigma where detections err by that much"
        )
    calibration = run.profiled()
    return replace(calibration, residuals=run.residuals(), contradicted=run.contradicted())


def _run_from_session(task: Task, rules: CalibrationRules, progress: Progress) -> _Run | None:
    """Run from the session's rig; return None if detections of any camera stay unexplained."""
    # all cameras together tell the body from others that a single camera may take for it
    if task.known is not None or task.times_matter or len(task.cameras) < 2 or not task.frames:
        return None
    probe = _thinned(task, rules)
    if sum(frame.is_sure for frame in posed_frames(probe)) <= len(probe.frames) / 2:
        return None
    start = Start.of(task.rig, posed_frames(task, progress=progress))
    run = _best_run(task, [start], rules, progress)
    wrong = () if run is None else run.calibration.doubtful(rules)
    if any("pose" not in task.free.get(s, ()) for s in wrong):  # a held pose must not change
        return None
    if wrong:  # these are placed later, by poses that the other cameras determine
        frames = tuple(frame.without(wrong) for frame in start.frames)
        run = _best_run(task, [replace(start, frames=frames, unlinked=wrong)], rules, progress)
    if run is None or not (run.fits and run.calibration.are_linked):
        return None
    return None if run.calibration.doubtful(rules) else run


def _thinned(task: Task, rules: CalibrationRules) -> Task:
    """Return the task with a few of its frames, spread evenly."""
    return replace(task, frames=task.frames[:: -(-len(task.frames) // rules.probes)])


def _run_from_cameras(
    task: Task, known: Known, rules: CalibrationRules, progress: Progress
) -> _Run | None:
    """Run from hypotheses of single cameras, and again without those of misplaced cameras."""
    # hypotheses of these cameras may have linked them wrongly; without any, they are placed by
    # poses that the other cameras determine
    run = _best_run(task, [start_from_cameras(task, known, rules)], rules, progress)
    if run is None or task.known is not None:
        return run
    wrong = {s for s in run.calibration.doubtful(rules) if "pose" in task.free.get(s, ())}
    if not wrong or len(wrong) + 1 > len(task.cameras):
        return run
    others = {key: poses for key, poses in known.items() if key[1] not in wrong}
    again = _best_run(task, [start_from_cameras(task, others, rules)], rules, progress)
    return max(run, again or run, key=lambda r: float(np.nansum(r.calibration.explained)))


def _with_best_blur(task: Task, rules: CalibrationRules, progress: Progress) -> CalibrationRules:
    """Return rules with the blur of the best run on a few frames, if frames are not fused."""
    probe = _thinned(task, rules)
    if task.known is not None or task.fuse or len(probe.frames) == len(task.frames):
        return rules
    run = _best_run(probe, starts_together(probe, rules, progress), rules, progress)
    return rules if run is None else replace(rules, widened=(run.start.factor,))


def _best_run(
    task: Task, starts: Iterable[Start], rules: CalibrationRules, progress: Progress
) -> _Run | None:
    """Return the run of the first start that tells features apart, or else the best run."""
    best: _Run | None = None
    for start in starts:
        if not len(start.frames):
            continue
        run = _Run(task, start, rules, progress)
        if best is None or run.worth > best.worth:
            best = run
        if run.worth >= (True, rules.certain):
            break
    return best


class _Run:
    """A calibration from one start; residuals and contradictions are left to the best run."""

    def __init__(
        self, task: Task, start: Start, rules: CalibrationRules, progress: Progress
    ) -> None:
        self.start = start
        self._whole_task, self._rules, self._progress = task, rules, progress
        self._pose_free = task.pose_free & (task.known is None)
        times = [f.time_s for f in start.frames if f.time_s is not None]
        steps = np.diff(np.unique(times)) if len(times) > 1 else np.ones(1)
        self._interval = float(np.median(steps))
        self._lay_out(start.unlinked)
        self.calibration = self._calibrated()

    @property
    def fits(self) -> bool:
        """Test whether residuals are smaller than those of chance matches."""
        return bool((self.calibration.noise < self._rules.failed * self._whole_task.sigmas).all())

    @property
    def worth(self) -> tuple[bool, float]:
        """Return the key by which the best run is chosen."""
        return self.fits, self.calibration.certainty

    def _lay_out(self, unlinked: Collection[int]) -> None:
        """Lay out the free parameters, but for sensors that are not linked yet."""
        self._unlinked = tuple(unlinked)
        free = {s: kinds for s, kinds in self._whole_task.free.items() if s not in unlinked}
        self._task = replace(self._whole_task, free=free)
        rig, poses = self.start.state
        # median distance from sensors to the body
        centres = np.array([centre_of(s) for s in rig.sensors])
        places = poses[:, :3, 3] + poses[:, :3, :3] @ rig.points.mean(axis=0)
        distances = np.linalg.norm(places[:, None] - centres[None], axis=2)
        body, self._length = self._task.body_free, float(max(np.median(distances), 1e-9))
        self._blocks = blocks_of(rig, free, body=body, length=self._length, interval=self._interval)

    def _calibrated(self) -> result.Calibration:
        """Adjust the rig, leave out bad frames, place late cameras, and adjust again."""
        start = self.start
        self._progress("adjusting all sensors together", 0, _STAGES)
        start, adjusted = self._adjusted(start)
        good = result.met_share(adjusted, start.frames, self._task) > self._rules.least_met
        bad: list[int] = []
        if good.any():  # else no sensor was placed yet
            bad = [f.number for f, ok in zip(start.frames, good, strict=True) if not ok]
            start = start.only(good)
        # from wider blurs, as crowded features make the first estimate of the noise too small
        self._progress("adjusting again, without bad frames", 1, _STAGES)
        start, adjusted = self._adjusted(start, adjusted.noise)
        extended = self._with_latecomers(start, adjusted.noise)
        if extended is not start:
            self._progress("adjusting with cameras that came late", 2, _STAGES)
            start, adjusted = self._adjusted(extended, adjusted.noise)
        self._last_start, self._adjustment = start, adjusted
        return self._summarised(start, adjusted, bad)

    def profiled(self) -> result.Calibration:
        """Return the calibration with deviations of lenses by how much worse the fit gets."""
        best = with_profiled_lenses(self._bundle(self._last_start), self._adjustment)
        self._adjustment = best
        return replace(self.calibration, deviations=best.deviations, covariance=best.covariance)

    def residuals(self) -> dict[int, result.Residual]:
        """Return residuals before and after, and of each frame by a rig adjusted without it.

        Matches are the same in all three, and poses are fitted to each rig.
        """
        start, best = self._last_start, self._adjustment
        folds = folds_of(len(start.frames), self._rules, runs=self._task.times_matter)
        rms, sensors = result.rms, range(len(self._task.rig.sensors))
        # without parameters of the rig, so that only poses are fitted, to every rig alike
        bundle = replace(self._bundle(start), blocks=(), gauge=lambda _: np.eye(0), errors={})
        _, before = fit_pairs(bundle, self._task.rig, best)
        _, after = fit_pairs(bundle, best.state.rig, best)
        held_back: list[list[Floats]] = [[] for _ in sensors]
        for fold in np.unique(folds[folds >= 0]):
            self._progress("holding back a part of the frames", 3 + int(fold), _STAGES)
            _, fit = self._adjusted(start.only(folds != fold), best.noise)
            undetermined = {
                block.sensor
                for block in self._blocks
                if (fit.undetermined & ~best.undetermined)[block.place].any()
            }
            _, squared = fit_pairs(bundle, fit.state.rig, best)
            for s in sensors:
                if s not in undetermined:
                    pairs = best.weighted[s][0].pairs
                    held_back[s].append(squared[s][folds[pairs.frame] == fold])
        return {
            s: result.Residual(rms([before[s]]), rms([after[s]]), rms(held_back[s]))
            for s in sensors
        }

    def contradicted(self) -> Contradiction | None:
        """Return what the recording contradicts most: what is held, or that no sensor moved."""
        sizes = {"length": self._length, "interval": self._interval}
        held = find_contradiction(self._bundle(self._last_start), self._adjustment, **sizes)
        return held if held is not None and held.frames else self._elsewhere() or held

    def _elsewhere(self) -> Contradiction | None:
        """Return the camera that stands elsewhere in frames in which it meets little, if any."""
        start, best, rules = self._last_start, self._adjustment, self._rules
        unmet = result.unmet_frames(best, start.frames, self._task, rules.least_met)
        for s in self._linked():
            rows = np.flatnonzero(unmet[:, s])
            frames = [start.frames[row] for row in rows]
            state = best.state._replace(poses=best.state.poses[rows])
            if len(frames) < rules.elsewhere:
                continue
            if self._place(s, state, frames, best.noise) is not None:
                name, numbers = self._task.rig.names[s], (frames[0].number, frames[-1].number)
                return Contradiction((name,), frames=numbers)
        return None

    def _linked(self) -> list[int]:
        """Return the cameras whose poses are known."""
        return [s for s in self._task.cameras if s not in self._unlinked]

    def _place(
        self, sensor: int, state: State, frames: Sequence[SeenFrame], noise: Floats
    ) -> Floats | None:
        """Place a camera by poses of the body; a cloud, without lines of sight, is not placed."""
        if isinstance(state.rig.sensors[sensor], CloudSensor):
            return None
        linked = self._linked()
        return place_camera(self._task, state, sensor, linked, frames, noise, self._rules)

    def _with_latecomers(self, start: Start, noise: Floats) -> Start:
        """Return the start with unlinked cameras placed, as far as possible, by its poses."""
        numbers = {frame.number: frame for frame in self._task.frames}
        frames = tuple(numbers[frame.number] for frame in start.frames)  # with all detections
        rig, unplaced = start.state.rig, list[int]()
        for s in self._unlinked:
            T = self._place(s, start.state, frames, noise)
            if T is None:
                unplaced.append(s)
            else:
                rig = rig.placed(s, T)
        if rig is start.state.rig:
            return start
        self._lay_out(unplaced)
        frames = tuple(frame.without(unplaced) for frame in frames)
        return replace(start, frames=frames, state=start.state._replace(rig=rig))

    def _bundle(self, start: Start) -> Bundle:
        task = self._task

        def gauge(rig: Rig) -> Floats:
            return self._gauge(start.state._replace(rig=rig))[0]

        constants = self._pose_free, gauge, task.sigmas, self._rules, task.errors
        return Bundle(start.frames, self._blocks, *constants)

    def _gauge(self, state: State) -> tuple[Floats, tuple[str, ...]]:
        return gauge_rows(state, self._blocks, self._pose_free, self._task.length)

    def _adjusted(self, start: Start, noise: Floats | None = None) -> tuple[Start, Adjusted]:
        """Adjust a start, from narrow blurs if the noise is known."""
        blurs = None if noise is None else 2 * self._rules.blur * noise
        adjusted = adjust(self._bundle(start), start.state, blurs=blurs)
        return replace(start, state=adjusted.state), adjusted

    def _of_held(self, kind: Kind, start: Start, adjusted: Adjusted) -> Floats:
        """Return the covariance (G, G) by errors of a held kind, where none is stated."""
        task, lens = self._task, result.HELD_LENS
        errors = {
            s: lens if kind == "focal" else CalibrationError(range_bias=float(task.sigmas[s]))
            for s, sensor in enumerate(task.rig.sensors)
            if kind in kinds_of(sensor) and kind not in task.free.get(s, ())
            if s not in task.errors
        }
        if not errors:
            return np.zeros(adjusted.covariance.shape)
        return covariance_by_held(replace(self._bundle(start), errors=errors), adjusted)

    def _summarised(self, start: Start, adjusted: Adjusted, bad: list[int]) -> result.Calibration:
        task, rig = self._task, adjusted.state.rig
        numbers = [f.number for f in start.frames]
        return result.Calibration(
            before=task.rig,
            after=rig,
            blocks=self._blocks,
            deviations=adjusted.deviations,
            covariance=adjusted.covariance,
            refused=_refused(self._blocks, adjusted, task.rig.names),
            gauge=self._gauge(start.state)[1],
            through=self.start.through,
            unlinked=self._unlinked,
            used=tuple(numbers),
            bad=tuple(sorted(bad)),
            recorded=len(task.frames),
            residuals={},
            noise=adjusted.noise,
            inflation=adjusted.inflation,
            certainty=adjusted.certainty,
            of_biases=self._of_held("range_bias", start, adjusted),
            of_lenses=self._of_held("focal", start, adjusted),
            explained=result.explained_share(adjusted, start.frames, task),
            met=result.met_detections(adjusted, numbers),
            poses=dict(zip(numbers, adjusted.state.poses, strict=True)),
        )


def _refused(blocks: Sequence[Block], adjusted: Adjusted, names: Sequence[str]) -> tuple[str, ...]:
    """Name the directions that are not determined."""
    labels = [
        f"{'body' if b.sensor is None else names[b.sensor]}:{b.kind} {name}"
        for b in blocks
        for name in b.names
    ]
    texts = []
    for direction in adjusted.unknown.T:
        strongest = np.argsort(-np.abs(direction), kind="stable")[:3]
        texts.append(" with ".join(labels[k] for k in strongest if abs(direction[k]) > 0.2))
    return tuple(texts)

"""Mutants of what learns bodies, smooths poses and finds the floor."""

from __future__ import annotations

from mutation.mutant import Mutant

MUTANTS = (
    Mutant(
        "trajectories-least-by-the-widest-pose",
        "trajectories/track.py",
        "floor = np.where(is_free, _FLOOR * largest[:, None], usual)",
        "floor = np.where(is_free, _FLOOR * largest.max(), usual)",
        "a pose that says nothing makes all others say nothing",
        ("test_smooth_choices.py",),
    ),
    Mutant(
        "trajectories-tell-the-size-of-a-body",
        "trajectories/smoothing.py",
        "if line.doubt and line.confidence is not None:",
        "if False:",
        "a body of another size is ok where it moves smoothly",
        ("test_smooth_choices.py",),
    ),
    Mutant(
        "learning-by-few-triples-alone",
        "learning/bodies.py",
        "least, RULES.many_bases)",
        "least, RULES.bases)",
        "a body that shows few of its markers for a while is learnt twice",
        ("test_learn.py",),
    ),
    Mutant(
        "trajectories-floor-of-a-body-that-turns",
        "trajectories/floor.py",
        "        _require_still(estimates, T)",
        "        pass",
        "the floor is that of a tool in the middle of its turns",
        ("test_align.py",),
    ),
    Mutant(
        "trajectories-first-pose-is-always-right",
        "trajectories/smoothing.py",
        "model, -1)[0] > _limit(track, rules):",
        "model, -1)[0] > np.inf:",
        "a wrong pose with which a recording begins stays ok",
        ("test_smooth_choices.py",),
    ),
    Mutant(
        "trajectories-first-frame-shows-the-body",
        "trajectories/choices.py",
        "log_unstarted = states_at(0), 0.0 if alternatives[0].may_be_none else -np.inf",
        "log_unstarted = states_at(0), -np.inf",
        "of hypotheses with which a recording begins one is right, though all are wrong",
        ("test_smooth_choices.py",),
    ),
    Mutant(
        "tracking-held-directions-tell-motion",
        "tracking/motion.py",
        "logs_now = np.where(deviation > 0, -0.5 * (np.log(variance) + off), 0.0)",
        "logs_now = -0.5 * (np.log(variance) + off)",
        "of a body whose tilt is held steady motion is believed whatever it does",
        ("test_tracking_track.py",),
    ),
    Mutant(
        "calibration-held-cameras-are-placed",
        "calibration/calibrate.py",
        'if any("pose" not in task.free.get(s, ()) for s in wrong):',
        "if False:",
        "a camera that is held is moved in silence",
        ("test_calibration.py",),
    ),
    Mutant(
        "calibration-bodies-beside-are-taken-for-it",
        "calibration/calibrate.py",
        "        run = _run_from_session(task, rules, progress)\n",
        "        run = None\n",
        "each camera is searched alone, and may take another body for the one that is sought",
        ("test_calibration.py",),
    ),
    Mutant(
        "cli-failed-runs-are-gone-on-with",
        "cli/recording_job.py",
        "begun.state == INTERRUPTED and _is_of(begun, job)",
        "_is_of(begun, job)",
        "a recording that was mended after it failed gives poses of both",
        ("test_cli_workers.py",),
    ),
    Mutant(
        "cli-poses-give-way-to-a-failure",
        "cli/recording_job.py",
        "if outcome.state == FAILED and existing is not None and existing.state == DONE:",
        "if False:",
        "poses are gone as a run with other options fails",
        ("test_cli_workers.py",),
    ),
)

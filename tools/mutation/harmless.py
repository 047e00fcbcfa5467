"""Mutants by rule that no test need notice, each with the reason.

They are known by their file and their line without and with the change, wherever that stands.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Harmless:
    """A mutant that changes nothing that anybody is promised.

    Attributes
    ----------
    file : str
        Below `pipeline/mixpose`.
    old, new : str
        The line without and with the change, without its indentation.
    reason : str
    """

    file: str
    old: str
    new: str
    reason: str


GUARDED = "zip(strict=True) only guards against lists that the code made of different lengths"

HARMLESS: tuple[Harmless, ...] = (
    Harmless(
        "calibration/adjust.py",
        "if (blur <= last / rules.narrowing).all():",
        "if (blur < last / rules.narrowing).all():",
        "blurs that are equal to the last bit",
    ),
    Harmless(
        "calibration/latecomers.py",
        "_MOST = 1_000_000  # detections of a frame",
        "_MOST = 1000001  # detections of a frame",
        "any number above that of the detections of a frame will do",
    ),
    Harmless(
        "calibration/rig.py",
        '_STEPS = {"focal": 1e-2, "principal_point": 1e-2, "distortion": 1e-5}',
        '_STEPS = {"focal": 0.02, "principal_point": 1e-2, "distortion": 1e-5}',
        "steps of derivatives, far from rounding and from where a lens is not linear",
    ),
    Harmless(
        "checking/evidence.py",
        "@dataclass(frozen=True)",
        "@dataclass(frozen=False)",
        "only guards against assignments, which mypy finds too",
    ),
    Harmless(
        "checking/geometry.py",
        'if estimate.status == "ok" or (estimate.status == "ambiguous" and weights > _LIKELY):',
        'if estimate.status == "ok" or (estimate.status == "ambiguous" and weights >= _LIKELY):',
        "weights that are equal to the last bit",
    ),
    Harmless(
        "checking/placement.py",
        "_TRIED = 64",
        "_TRIED = 128",
        "only speed: more orientations are tried",
    ),
    Harmless(
        "design/advice.py",
        "if excess(low) > 0 or excess(high) < 0:",
        "if excess(low) >= 0 or excess(high) < 0:",
        "errors that are equal to the last bit",
    ),
    Harmless(
        "design/prediction.py",
        "arms = prediction.poses[:, :3, :3] @ tip",
        "arms = prediction.poses[:, :6, :3] @ tip",
        "equivalent: of arms three numbers are read, and the fourth is zero",
    ),
    Harmless(
        "frames/live.py",
        "_RETRY_S = 0.5  # between two attempts to open a source",
        "_RETRY_S = 1.0  # between two attempts to open a source",
        "only how soon a source that is not there yet is found",
    ),
    Harmless(
        "learning/bodies.py",
        "slack = RULES.gate * np.sqrt(2.0) * np.hypot(others.typical, reference.sigma[base].max())",
        "slack = RULES.gate * np.sqrt(4.0) * np.hypot(others.typical, reference.sigma[base].max())",
        "only speed: more triples are tried, of which those count whose points are met",
    ),
    Harmless(
        "learning/points.py",
        "if log_likelihood > largest:",
        "if log_likelihood >= largest:",
        "likelihoods that are equal to the last bit",
    ),
    Harmless(
        "pictures/advice.py",
        "if size[extra].min() > 1.25 * size[claimed].max():",
        "if size[extra].min() >= 1.25 * size[claimed].max():",
        "sizes that are equal to the last bit",
    ),
    Harmless(
        "pictures/plots.py",
        "places = np.stack([ranges, np.zeros_like(ranges)], axis=-1)[None, None]",
        "places = np.stack([ranges, np.zeros_like(ranges)], axis=+1)[None, None]",
        "equivalent: of two arrays of one axis",
    ),
    Harmless(
        "pictures/plots.py",
        "scale = next((n for n in (1, 2, 5, 10, 20, 50, 100, 200, 500) "
        "if n * share >= 0.15), 1000)",
        "scale = next((n for n in (1, 2, 5, 10, 20, 50, 100, 200, 500) if n * share > 0.15), 1000)",
        "an ellipse that fills exactly 0.15 of a map",
    ),
    Harmless(
        "pictures/scene.py",
        "if np.isfinite(low) and np.isfinite(high) and high > low:",
        "if np.isfinite(low) and np.isfinite(high) and high >= low:",
        "a sensor that measures one range",
    ),
    Harmless(
        "poses/consistency.py",
        "kept = values > 1e-9",
        "kept = values > 2e-09",
        "between the rounding of a correlation, 1e-15, and any that is measured",
    ),
    Harmless(
        "poses/trajectories.py",
        "@dataclass(frozen=True, eq=False)",
        "@dataclass(frozen=False, eq=False)",
        "only guards against assignments, which mypy finds too",
    ),
    Harmless(
        "publishing/channel.py",
        'buffer: int = constant(2**16, "bytes that the system holds of a connection: '
        'some 20 poses")',
        'buffer: int = constant(2*16, "bytes that the system holds of a connection: '
        'some 20 poses")',
        "only how many poses wait in the system, which takes no less than some kB",
    ),
    Harmless(
        "publishing/lsl.py",
        "_FLUSH_S = 0.5  # outlets send in a thread of their own, which ends with them",
        "_FLUSH_S = 1.0  # outlets send in a thread of their own, which ends with them",
        "only how long the end of a run waits for what was sent",
    ),
    Harmless(
        "publishing/ros2.py",
        "_DEPTH = 10  # of the queues of publishers, as in ROS's examples",
        "_DEPTH = 11  # of the queues of publishers, as in ROS's examples",
        "only how many messages wait, as in examples of ROS",
    ),
    Harmless(
        "report/page.py",
        'return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"',
        'return f"{value:.0f}" if 1000 <= abs(value) <= 1e6 else f"{value:.3g}"',
        "a number that is exactly a million, written either way",
    ),
    Harmless(
        "report/series.py",
        "usual = np.median(steps[1:]) if len(steps) > 1 else 1.0",
        "usual = np.median(steps[1:]) if len(steps) > 1 else 2.0",
        "equivalent: the steps of a single frame are 0",
    ),
    Harmless(
        "runner.py",
        "LEAST_DELAY_S = 1e-6",
        "LEAST_DELAY_S = 2e-06",
        "between the rounding of times since 1970, 2.4e-7 s, and delays in which anything moves",
    ),
    Harmless(
        "search/from_points.py",
        "cuts[:, i] = False",
        "cuts[:, i] = True",
        "more guesses, which are judged as all others are",
    ),
    Harmless(
        "search/problem.py",
        'places = places[:, np.argsort(-blurred[tuple(places)], kind="stable")'
        "[: 8 * THOROUGH.sample]]",
        'places = places[:, np.argsort(-blurred[tuple(places)], kind="stable")'
        "[: 16 * THOROUGH.sample]]",
        "only speed: more of the faintest peaks are tried",
    ),
    Harmless(
        "search/search.py",
        "if self._are_sufficient(poses[:3], best):",
        "if self._are_sufficient(poses[:4], best):",
        "only speed: a fourth guess is refined at once",
    ),
    Harmless(
        "search/search.py",
        "if self._are_sufficient(poses[:3], best):",
        "if self._are_sufficient(poses[:6], best):",
        "only speed: three more guesses are refined at once",
    ),
    Harmless(
        "search/search.py",
        "if self._coverage() < budget.sufficient and not is_guessed:",
        "if self._coverage() <= budget.sufficient and not is_guessed:",
        "a share that is exactly the one that suffices",
    ),
    Harmless(
        "search/triples.py",
        "outer = far_apart(rays.pixels, 3 * budget.sample // 2)",
        "outer = far_apart(rays.pixels, 4 * budget.sample // 2)",
        "only speed: more of the outermost detections are tried",
    ),
    Harmless(
        "session/messages.py",
        "_LONGEST = 60  # characters of a found value that are shown",
        "_LONGEST = 61  # characters of a found value that are shown",
        "any width that a line has room for will do",
    ),
    Harmless(
        "sensors/cloud.py",
        "return np.asarray(cosines > (edge_on if sensor.dimension > 1 else 0.0))",
        "return np.asarray(cosines >= (edge_on if sensor.dimension > 1 else 0.0))",
        "a face is exactly edge-on only by rounding",
    ),
    Harmless(
        "tracking/doubt.py",
        "if best.residual_ratio > rules.changed:",
        "if best.residual_ratio >= rules.changed:",
        "a ratio that is equal to the last bit",
    ),
    Harmless(
        "tracking/in_motion.py",
        "is_asked = frame.frame % frame.rules.timing.asked == 0 or frame.is_timed",
        "is_asked = frame.frame % frame.rules.timing.asked == 1 or frame.is_timed",
        "one of so many frames is asked, whichever it is",
    ),
    Harmless(
        "tracking/proposers.py",
        "(chosen,) = (most * (1 - near[1:] / max(near[0], 1e-12)) < least).nonzero()",
        "(chosen,) = (most * (1 - near[1:] * max(near[0], 1e-12)) < least).nonzero()",
        "only speed: more poses are looked up, as counts are at least 1",
    ),
    Harmless(
        "trajectories/intensity.py",
        "(5.0, 5, _EACH),",
        "(5.0, 10, _EACH),",
        "only speed: more points of a search whose later passes are as fine as before",
    ),
    Harmless(
        "checking/placement.py",
        "seen_at_best = 0",
        "seen_at_best = 1",
        "where one sensor sees one feature, and no more from any side, no pose is typical",
    ),
    Harmless(
        "calibration/start.py",
        "width = 4 * _BIAS_STEPS",
        "width = 5 * _BIAS_STEPS",
        "four deviations out a kernel is as good as zero",
    ),
    Harmless(
        "calibration/gauge.py",
        "along = (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])",
        "along = (p[1] - p[0]) * np.linalg.norm(p[1] - p[0])",
        "what is across it, and in its plane, hangs on its direction alone",
    ),
    Harmless(
        "design/study.py",
        "drawn = qmc.Halton(6, rng=np.random.default_rng(seed)).random(count)",
        "drawn = qmc.Halton(12, rng=np.random.default_rng(seed)).random(count)",
        "six of twelve columns are as evenly spread",
    ),
    Harmless(
        "search/search.py",
        "best, best_checked, batches, repeats = 0.0, 0.0, skip, 0",
        "best, best_checked, batches, repeats = 0.0, 1.0, skip, 0",
        "guesses that explain two detections are never enough, whether that is asked or not",
    ),
)

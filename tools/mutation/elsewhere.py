"""Mutants of poses where nothing lets expect them, deviations of lenses, and what is meant."""

from __future__ import annotations

from mutation.mutant import Mutant

_RANGES, _STARTS = "test_tracking_ranges.py", "test_tracking_starts.py"
_FREE = "test_calibration_free.py"

MUTANTS = (
    Mutant(
        "tracking-ranges-leave-no-room",
        "tracking/proposers.py",
        "return odds > rules.acceptance.log_doubt",
        "return False",
        "a trolley is ok at a wrong turn, as no other is looked at",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-always-leave-room",
        "tracking/proposers.py",
        "return odds > rules.acceptance.log_doubt",
        "return True",
        "a trolley that is followed is searched for at all turns in each frame",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-met-however-far-off",
        "tracking/likelihood.py",
        "ahead = float((found.most - found.reached / 2 - found.log_odds)[0])",
        "ahead = 0.0",
        "a body that is elsewhere is not looked for where it hardly meets anything",
        (_RANGES,),
    ),
    Mutant(
        "tracking-far-off-in-the-first-frames-convinces",
        "tracking/proposers.py",
        "one.residual_ratio > 1 and not one.left_out for one",
        "False for one",
        "the body is followed to its double image in a pane",
        (_STARTS,),
    ),
    Mutant(
        "tracking-what-is-left-out-is-looked-for",
        "tracking/proposers.py",
        "one.residual_ratio > 1 and not one.left_out for one",
        "one.residual_ratio > 1 for one",
        "frames that leave a sensor out are doubted, as those that do not",
        (_STARTS,),
    ),
    Mutant(
        "tracking-weighed-where-it-was-expected",
        "tracking/tracker.py",
        "if not are_cut_otherwise(data.views, views):",
        "if True:",
        "a body that comes nearer at once is ambiguous, as its whole spots pass for merged ones",
        ("test_tracking_sizes.py",),
    ),
    Mutant(
        "tracking-one-more-than-count-is-no-surprise",
        "tracking/sharing.py",
        "lacking = {id(one.body) for k, one in enumerate(self.bodies) if k not in self.claimed}",
        "lacking = {id(one.body) for one in self.bodies if one.instance is not None}",
        "an unknown thing is followed in place of one of two equal bodies that leaves",
        ("test_tracking_twin.py",),
    ),
    Mutant(
        "calibration-deviations-by-one-linear-model",
        "calibration/profile.py",
        "if share > rules.flat or wider >= most:",
        "if True:",
        "the focal length of a camera that sees a board straight on is told to 0.4 %",
        (_FREE,),
    ),
    Mutant(
        "calibration-what-is-beside-a-lens-stays",
        "calibration/profile.py",
        "along = (ends[1][0] - ends[0][0]) / (2 * rules.far * wider)",
        "along = told",
        "a second camera is told to know its lens as little as the first",
        (_FREE,),
    ),
    Mutant(
        "calibration-a-length-that-contradicts-the-body-is-believed",
        "calibration/telling.py",
        "if abs(np.log(scale)) > rules.rescaled:",
        "if False:",
        "a digit that is typed wrong makes the rig and the body smaller without a word",
        (_FREE,),
    ),
    Mutant(
        "tracking-a-mirrored-camera-is-meant",
        "tracking/arguments.py",
        'if not is_rigid(getattr(sensor, "T_sensor_world", np.eye(4))):',
        "if False:",
        "poses of programs are lost without a reason",
        ("test_records.py",),
    ),
    Mutant(
        "tracking-views-of-one-name-count-twice",
        "tracking/arguments.py",
        "if names.count(name) > 1",
        "if names.count(name) > 2",
        "a view that is given twice halves the covariance",
        ("test_records.py",),
    ),
)

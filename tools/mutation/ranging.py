"""Mutants of single ranges: their likelihood, its maxima, and what frames tell of these."""

from __future__ import annotations

from mutation.mutant import Mutant

_RANGES, _MAXIMA = "test_tracking_ranges.py", "test_tracking_range_maxima.py"

MUTANTS = (
    Mutant(
        "tracking-ranges-forget-the-noise-of-cameras",
        "tracking/ranges.py",
        "before.followed(RANGES, noise, before.moments, before.biases, before.fields)",
        "before.followed(RANGES, noise)",
        "after a frame of ranges alone cameras are as in the first frame",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-any-clutter",
        "tracking/ranges.py",
        "false = np.maximum(found - probability * expected, 1 - probability)",
        "false = np.full(expected.shape, 1 - probability)",
        "ranges are believed alike however many are false",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-missed-for-free",
        "tracking/ranges.py",
        "missed = expected * np.log(1 - probability) +",
        "missed = 0 * expected +",
        "poses whose tags have no range are as good as those that meet all",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-noise-never-learnt",
        "tracking/ranges.py",
        "return max(1.0, float(np.sqrt(squares / degrees)))",
        "return 1.0",
        "ranges that err by more than said are believed",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-open-directions-unbounded",
        "tracking/ranges.py",
        "information += np.diag(1 / frame.anywhere[1][free] ** 2)",
        "information += 0",
        "directions that ranges leave open have no bound",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-covariance-not-enlarged",
        "tracking/ranges.py",
        "C *= rules.judgement.noise.enlargement(degrees)",
        "C *= 1.0",
        "covariances of ranges are too small at first",
        (_RANGES,),
    ),
    Mutant(
        "tracking-ranges-unlikely-maxima-forgotten",
        "tracking/tracker.py",
        "sorted(verdict.faint if fuse else (), key=lambda each: -each[1])",
        "list[tuple[ScoredPose, float]]()",
        "where frames tell that another turn is right, that has to be found anew in one of them",
        (_MAXIMA,),
    ),
    Mutant(
        "tracking-ranges-one-maximum-a-prediction",
        "tracking/proposers.py",
        "(predicted, within, multistart",
        "(predicted, multistart",
        "where the pose before allows several maxima one of them is believed",
        (_MAXIMA,),
    ),
    Mutant(
        "tracking-ranges-rivals-told-by-the-frame-that-tells-most",
        "tracking/rivals.py",
        "if best.spread is not None:",
        "if False:",
        "of single ranges what frames tell does not add up",
        (_MAXIMA,),
    ),
    Mutant(
        "tracking-ranges-in-mirrors",
        "tracking/mirrors.py",
        "for view in data.views if view.sensor.dimension == 2]",
        "for view in data.views]",
        "a turn is left out as the image of another in a mirror, which ranges do not see",
        (_MAXIMA,),
    ),
    Mutant(
        "tracking-ranges-room-elsewhere-forgotten",
        "tracking/ranges.py",
        "np.logaddexp(frame.track.elsewhere, -expected)",
        "-expected",
        "a search that missed the right turn is the last, however ill frames go on to fit",
        (_MAXIMA,),
    ),
    Mutant(
        "tracking-ranges-false-detections-outside-the-ellipsoid",
        "tracking/ranges.py",
        "if squares > limit:",
        "if squares < 0:",
        "where one detection may be false covariances are those of it being right",
        (_MAXIMA,),
    ),
    Mutant(
        "tracking-ranges-same-maximum-many-times",
        "tracking/ranges.py",
        "for k in order[unlike(frame.body, ends[order], cell, whole=True)]:",
        "for k in order:",
        "poses that are one are judged as often as starts lead to them",
        (_MAXIMA,),
    ),
    Mutant(
        "search-ranges-from-the-middle-alone",
        "search/poses.py",
        "[np.zeros((1, 3)), aside, -aside] if aside.any()",
        "[np.zeros((1, 3))] if aside.any()",
        "false ranges move the middle, and with it all places that are tried",
        (_MAXIMA,),
    ),
)

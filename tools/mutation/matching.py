"""Mutants of `matching`."""

from __future__ import annotations

from mutation.mutant import Mutant

_ERRORS = (
    Mutant(
        "matching-errors-cut-by-the-blur",
        "matching/matches.py",
        "factor = 1 / (1 - min(0.5 * q / blur**2, 0.5))",
        "factor = 1.0",
        "the noise seems smaller than it is",
    ),
    Mutant(
        "matching-errors-of-all-detections-alike",
        "matching/matches.py",
        "weights = counts * welsch(squared, blurs)",
        "weights = counts",
        "a cut spot is noise of all others",
    ),
    Mutant(
        "matching-cut-spots-are-noise",
        "matching/matches.py",
        "alike = expected / (expected + matches.extra)",
        "alike = np.ones(matches.shares.shape)",
        "noise is taken to be as large as what cut spots are off by",
        ("test_judgement_noise.py", "test_matching_errors.py"),
    ),
    Mutant(
        "matching-errors-of-a-frame-forgotten",
        "matching/matches.py",
        "np.maximum(variances, pooled(in_frame, rules, 0.0))",
        "variances.copy()",
        "a frame that is not like those before it is looked at too narrowly",
    ),
    Mutant(
        "matching-errors-from-above-only",
        "matching/matches.py",
        "return max(wide, narrow, key=lambda seen: log_likelihood(seen[2], matches, free, rules))",
        "return wide",
        "where half of the spots are merged all offsets are noise",
    ),
    Mutant(
        "matching-errors-each-sensor-for-itself",
        "matching/matches.py",
        "wide = (wide + float(wide @ coordinates) / sum(coordinates)) / 2",
        "wide = wide + 0.0",
        "sensors weigh by their own noise alone",
    ),
)

_MET = (
    Mutant(
        "matching-own-detection-is-another",
        "matching/associate.py",
        "squared[which == by[..., None]] = np.nan",
        "squared[which == by[..., None]] = 0.0",
        "every feature is pulled by a detection beside it, it seems, and fits never end early",
        ("test_fit_noise.py",),
    ),
    Mutant(
        "matching-detection-met-twice",
        "matching/associate.py",
        "(by_i[i] == remaining) & (by_j[j] == remaining)",
        "by_i[i] == remaining",
        "one detection is taken for several features, hidden ones count as seen",
    ),
    Mutant(
        "matching-farthest-detection-met",
        "matching/associate.py",
        'squared[k, i, at].argsort(kind="stable")',
        '(-squared[k, i, at]).argsort(kind="stable")',
        "features take the detection of their neighbour",
    ),
    Mutant(
        "matching-hidden-beside-seen-is-a-pair",
        "matching/associate.py",
        "if near[k] and closer[k] < 0:",
        "if near[k]:",
        "a hidden feature beside a seen one counts as merged with it",
    ),
    Mutant(
        "matching-merged-detection-counts-twice",
        "matching/associate.py",
        "weights[pair] / 2, middle[k]",
        "weights[pair], middle[k]",
        "two features that share a detection count as two measurements",
    ),
    Mutant(
        "matching-merged-detection-shared-by-three",
        "matching/associate.py",
        "single[k] = False",
        "single[k] = True",
        "a third feature takes a detection that two share already",
    ),
    Mutant(
        "matching-neighbours-pull-taken-for-misfit",
        "matching/associate.py",
        "pull = sampled[:, 1:] - predicted_gradient",
        "pull = sampled[:, 1:]",
        "features of grey values that overlap seem to be off where they fit",
    ),
    Mutant(
        "matching-crowd-of-the-whole-image",
        "matching/associate.py",
        "return np.maximum(number / overall, inside / in_box), in_space",
        "return number / overall, in_space",
        "a crowd of false detections around the body counts as rare",
    ),
    Mutant(
        "matching-crowd-constant",
        "matching/associate.py",
        "return np.maximum(number / overall, inside / in_box), in_space",
        "return 1e-6 + 0 * in_box, in_space",
        "clutter does not make a pose less sure",
    ),
    Mutant(
        "matching-unmatched-within-the-body-only",
        "matching/associate.py",
        "half = size / 2 + rules.slip * size.max(axis=1, keepdims=True)",
        "half = size / 2",
        "detections beside a slipped grid go unnoticed",
    ),
    Mutant(
        "matching-unmatched-with-those-met",
        "matching/associate.py",
        "axis=2), axis=1) - met",
        "axis=2), axis=1) * 1.0",
        "every frame with a missed feature looks like a slip",
    ),
)

_RECORD = (
    Mutant(
        "matching-jacobian-in-the-sensors-unit",
        "matching/associate.py",
        "J / sigmas[:, None, None, None]",
        "J / 1.0",
        "covariances depend on the unit of a sensor",
    ),
    Mutant(
        "matching-merged-features-move-as-one",
        "matching/associate.py",
        "if np.count_nonzero(merged):",
        "if False:",
        "the middle of two features moves as if it were one of them",
        ("test_tracking_outliers.py",),
    ),
    Mutant(
        "matching-spread-of-a-body-is-no-reach",
        "matching/associate.py",
        "if body.spread:",
        "if False:",
        "features of a body that gives way are missed where they have moved",
    ),
    Mutant(
        "matching-calibration-of-the-first-sensor",
        "matching/associate.py",
        "column[k, :, : shifts.shape[1]] = shifts",
        "column[0, :, : shifts.shape[1]] = shifts",
        "a calibration in doubt makes another sensor unsure",
    ),
    Mutant(
        "matching-out-of-view-is-covered",
        "matching/matches.py",
        "np.maximum(self.expected + self.unseen, 1e-12)",
        "np.maximum(self.expected, 1e-12)",
        "a body half out of the picture convinces",
        ("test_judgement_acceptance.py",),
    ),
    Mutant(
        "matching-ranges-have-two-coordinates",
        "matching/matches.py",
        "self.met * self.dimensions * self.coordinate_weight",
        "self.met * 2 * self.coordinate_weight",
        "ranges seem to fix poses that they leave open",
    ),
    Mutant(
        "matching-points-in-space-have-six-coordinates",
        "matching/matches.py",
        "np.where(self.images > 1, 0.5, 1.0)",
        "np.where(self.images > 1, 1.0, 1.0)",
        "points in space fix poses that they leave open",
    ),
    Mutant(
        "matching-images-of-a-cloud-are-sensors",
        "matching/associate.py",
        "owners[planes] = planes[0]",
        "owners[planes] = planes",
        "a cloud outvotes the camera beside it",
    ),
    Mutant(
        "matching-images-of-a-cloud-are-met-apart",
        "matching/associate.py",
        "for planes in clouds:  # each coordinate",
        "for planes in ():  # each coordinate",
        "a point that is one behind another in an image is taken for it",
    ),
    Mutant(
        "matching-filled-up-with-the-first-detection",
        "matching/matches.py",
        '-1 if name == "detections" else 0',
        "0",
        "bodies of fewer features own a detection that is another's",
    ),
)

MUTANTS = (*_ERRORS, *_MET, *_RECORD)

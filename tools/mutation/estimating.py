"""Mutants of `fit`."""

from __future__ import annotations

from mutation.mutant import Mutant

_PRIOR = "test_fit_prior.py"

_NEAR = (
    Mutant(
        "fit-blurs-from-fine-to-coarse",
        "fit/near.py",
        "for k in range(count, -1, -1)]",
        "for k in range(count + 1)]",
        "fits end at the coarsest blur",
    ),
    Mutant(
        "fit-blurs-whatever-the-uncertainty",
        "fit/near.py",
        "(match.J**2 @ (uncertainties**2)[:, None, :, None])",
        "(match.J**2 @ (0 * uncertainties)[:, None, :, None])",
        "a start that is far off is looked for at the finest blur alone",
    ),
    Mutant(
        "fit-blurs-wider-than-the-picture",
        "fit/probable.py",
        "widest: float = constant(\n        0.1,",
        "widest: float = constant(\n        10.0,",
        "descents begin where everything is one blob",
    ),
    Mutant(
        "fit-all-starts-lead-to-one",
        "fit/near.py",
        "curvature[0] @ away) < same",
        "curvature[0] @ away) * 0 < same",
        "rivals are taken for the pose that was found first",
    ),
    Mutant(
        "fit-always-at-the-finest-blur",
        "fit/near.py",
        "start.value[0] >= rules.near * len(objective.views)",
        "start.value[0] >= 0.0",
        "a start some widths off is never corrected",
    ),
    Mutant(
        "fit-false-spots-draw-unnoticed",
        "fit/near.py",
        ">= rules.moved**2 * variances).any()",
        ">= 1e9 * rules.moved**2 * variances).any()",
        "the pose is drawn to a false spot beside a feature that is met, or to a neighbour's",
    ),
    Mutant(
        "fit-prior-around-the-answer",
        "fit/near.py",
        "NormalPrior(T_start, uncertainty, free)",
        "NormalPrior(T, uncertainty, free)",
        "what is known of the start does not count",
    ),
)

_NARROW = (
    Mutant(
        "fit-hidden-features-push-each-other-apart",
        "fit/near.py",
        "np.nansum(pulls, axis=1) + _pulls_of_missed(matches, blurs)",
        "np.nansum(pulls, axis=1)",
        "two hidden features that run into each other move the pose by seven deviations",
        ("test_fit_noise.py",),
    ),
    Mutant(
        "fit-ends-at-sigma",
        "fit/near.py",
        "return not (far or is_pulled), ",
        "return True, ",
        "a cut spot bends the pose",
        ("test_fit_noise.py",),
    ),
    Mutant(
        "fit-narrows-for-nothing",
        "fit/near.py",
        "< rules.moved**2",
        "< 0.0",
        "fits of large bodies draw every density three times",
        ("test_fit_noise.py",),
    ),
    Mutant(
        "fit-sensors-weigh-the-same",
        "fit/near.py",
        "objective.in_nats(blurs * blurs / weighed)",
        "objective.in_nats(blurs * blurs / weighed.mean())",
        "a camera that finds spots to 0.02 px counts no more than one that errs by 0.4 px",
        ("test_fit_noise.py",),
    ),
    Mutant(
        "fit-heights-of-ranges-beside-a-camera-are-alike",
        "fit/near.py",
        "likeliest = -np.inf if is_rough else likeliest",
        "is_rough = not is_rough",
        "a range is off wherever peaks of features overlap, by the same for as long as they do",
        ("test_mixed_rig.py",),
    ),
    Mutant(
        "matching-errors-of-calibration-are-noise",
        "matching/matches.py",
        "max(fields, self.common)",
        "self.common",
        "a camera that was turned after its calibration hardly counts",
        ("test_fit_noise.py",),
    ),
    Mutant(
        "fit-move-without-the-noise",
        "fit/near.py",
        "(weights / (variances[:, None] + matches.extra)).repeat(2)",
        "weights.repeat(2)",
        "how far narrower blurs move the pose is told in σ_ε, not in standard deviations",
        ("test_fit_noise.py",),
    ),
)

_PROBABLE = (
    Mutant(
        "objective-prior-ignored",
        "objective/terms.py",
        "np.where(self.free, 1 / np.maximum(self.uncertainty, 1e-12) ** 2, 0.0)",
        "np.zeros(6)",
        "what is known of the start does not count",
        (_PRIOR,),
    ),
    Mutant(
        "objective-prior-repels",
        "objective/terms.py",
        "Quadratic(0.5 * (away * pull).sum(axis=1), pull, C, C)",
        "Quadratic(0.5 * (away * pull).sum(axis=1), -pull, C, C)",
        "the gradient of the prior has the wrong sign",
        (_PRIOR,),
    ),
    Mutant(
        "fit-first-maximum-is-the-best",
        "fit/probable.py",
        "return bool(self.shares.min() > 0.5)",
        "return True",
        "under heavy noise the next peak is taken for the highest",
        (_PRIOR,),
    ),
    Mutant(
        "objective-prior-points-too-close",
        "objective/terms.py",
        "steps = np.sqrt(self.free.sum()) * np.diag(",
        "steps = np.diag(",
        "other maxima are sought within less than the prior allows",
        (_PRIOR,),
    ),
    Mutant(
        "fit-likelihood-twice-as-sure",
        "fit/probable.py",
        "weights = (0.5 * objective.energies[:, 0] / (misfit * noise))[:, None]",
        "weights = (objective.energies[:, 0] / (misfit * noise))[:, None]",
        "the data outweigh the prior by twice what their noise allows",
        (_PRIOR,),
    ),
    Mutant(
        "fit-misfit-not-in-the-noise",
        "fit/probable.py",
        "weights = (0.5 * objective.energies[:, 0] / (misfit * noise))[:, None]",
        "weights = (0.5 * objective.energies[:, 0] / noise)[:, None]",
        "a body that does not fit is believed as one that does",
        (_PRIOR,),
    ),
    Mutant(
        "fit-noise-of-all-the-energy",
        "fit/probable.py",
        "np.maximum(1 - shares, 1e-9) * energies / cells",
        "energies / cells",
        "what the body explains counts as noise",
        (_PRIOR,),
    ),
)

_MISFIT = (
    Mutant(
        "fit-every-body-fits",
        "fit/probable.py",
        "return statistic / freedom",
        "return 1.0",
        "a deformed body pulls the pose where its features happen to fit",
    ),
    Mutant(
        "fit-amplitudes-are-free",
        "fit/probable.py",
        "statistic, freedom = 0.0, -unknowns",
        "statistic, freedom = 0.0, 0",
        "a misfit is divided by coordinates that the fit has used up",
    ),
    Mutant(
        "fit-misfit-in-units-of-the-sensor",
        "fit/probable.py",
        "return np.sqrt(self.variance) * sampled[:, 1:] - slopes, heights",
        "return self.variance * sampled[:, 1:] - slopes, heights",
        "whether a body fits depends on the unit of its sensor",
    ),
    Mutant(
        "fit-neighbours-are-misfit",
        "fit/probable.py",
        "slopes = -((bells * heights)[..., None] * away).sum(axis=1)",
        "slopes = np.zeros(y.shape)",
        "features that overlap seem not to fit",
    ),
    Mutant(
        "fit-own-peaks-left",
        "fit/probable.py",
        "y = y + np.sqrt(sensor.variance) * slopes / tops[:, None]",
        "y = y - np.sqrt(sensor.variance) * slopes / tops[:, None]",
        "freed features leave their peaks",
    ),
    Mutant(
        "fit-features-go-to-the-farthest-place",
        "fit/probable.py",
        "linear_sum_assignment(cost)[1]",
        "linear_sum_assignment(-cost)[1]",
        "places of features are mixed up",
    ),
    Mutant(
        "fit-any-assignment-is-believed",
        "fit/probable.py",
        "return T_best if ((other_squares / least) ** (-0.5 * redundant)).sum() < 1 else None",
        "return T_best",
        "a pose is told although two places might be each other's",
    ),
    Mutant(
        "fit-lower-peaks-do-not-count",
        "fit/probable.py",
        "return y if highest < 0.5 * tops.mean() < sensor.density(y)[:, 0].min() else None",
        "return y",
        "features without a peak of their own are freed",
    ),
)

MUTANTS = (*_NEAR, *_NARROW, *_PROBABLE, *_MISFIT)

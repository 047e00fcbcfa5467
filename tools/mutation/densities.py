"""Mutants of `density` and `objective`."""

from __future__ import annotations

from mutation.mutant import Mutant

_ATLAS = (
    Mutant(
        "density-second-detection-of-a-page-lost",
        "density/atlas.py",
        "place = np.arange(len(number)) - np.searchsorted(number, number)",
        "place = np.zeros_like(number)",
        "of two detections on one page only one is there",
    ),
    Mutant(
        "density-drawn-too-narrowly",
        "density/atlas.py",
        "REACH = 4.25",
        "REACH = 2.5",
        "features four widths apart draw each other",
    ),
    Mutant(
        "density-normalised-by-two-pi",
        "density/atlas.py",
        "(math.sqrt(2 * np.pi) * width) ** -dimensions",
        "(2 * np.pi * width) ** -dimensions",
        "ranges and images weigh otherwise than they should",
    ),
    Mutant(
        "density-gradient-of-the-other-sign",
        "density/atlas.py",
        "slopes = bells * away",
        "slopes = -bells * away",
        "an ascent runs away from the detections",
    ),
    Mutant(
        "density-look-up-blurs-once-more",
        "density/atlas.py",
        "self._sigma = math.sqrt(steps_per_sigma**2 - _SPLINE)",
        "self._sigma = steps_per_sigma",
        "peaks of densities are too low by what a spline blurs",
    ),
    Mutant(
        "density-ranges-pull-across",
        "density/atlas.py",
        "bells[flat, 1], away[flat, 1] = 1.0, 0.0",
        "bells[flat, 1], away[flat, 1] = 1.0, 1.0",
        "the coordinate that a range does not have pulls at the pose",
    ),
    Mutant(
        "density-look-up-without-the-spline",
        "density/atlas.py",
        "beside += 0.25",
        "beside *= 0.0",
        "places of features are drawn to cells",
    ),
    Mutant(
        "density-pages-begin-anywhere",
        "density/atlas.py",
        "origin = page * np.floor((lower - (reach + page + 0.5)) / page)",
        "origin = lower - (reach + page + 0.5)",
        "the last digits of a pose change with detections that have no part in it",
    ),
    Mutant(
        "density-grid-pages-transposed",
        "density/atlas.py",
        "u, v = (cells / self.per_unit[sensor, 0, 0, 0]).T",
        "v, u = (cells / self.per_unit[sensor, 0, 0, 0]).T",
        "grey values lie mirrored at the diagonal",
    ),
)

_BLUR = (
    Mutant(
        "density-noise-cancels-itself",
        "density/blur.py",
        "absolute = float(np.abs(pattern.values).sum(dtype=np.float64))",
        "absolute = float(pattern.values.sum(dtype=np.float64))",
        "a profile whose noise sums to about zero is normalised by about zero",
    ),
    Mutant(
        "density-blocks-blur-once-more",
        "density/blur.py",
        "left = np.sqrt(max(sigma**2 - (step**2 - pattern.step**2) / 6, 0.0))",
        "left = sigma",
        "wide blurs of grey values are wider than said",
    ),
    Mutant(
        "density-blocks-half-a-pixel-aside",
        "density/blur.py",
        "(factor - 1) / 2 * pattern.step",
        "factor / 2 * pattern.step",
        "coarse blurs of grey values are half a pixel aside",
    ),
    Mutant(
        "density-slope-of-a-blur-turned-round",
        "density/blur.py",
        "values * away * np.float32(-1.0 / sigma)",
        "values * away * np.float32(1.0 / sigma)",
        "gradients of grey values have the wrong sign",
    ),
    Mutant(
        "density-matched-as-wide-as-plain",
        "density/observation.py",
        "variance = (2 if matched else 1) * sigma**2",
        "variance = (1 if matched else 1) * sigma**2",
        "the density of predicted features is too narrow by half of its variance",
    ),
    Mutant(
        "density-blurred-although-blurred-already",
        "density/observation.py",
        "* sigma**2 - self.intrinsic**2",
        "* sigma**2",
        "a measurement that is a density already is blurred twice",
    ),
    Mutant(
        "density-energy-of-the-finest-blur",
        "density/observation.py",
        "self._finest_energy if sigma == self.sigma else",
        "self._finest_energy if sigma >= self.sigma else",
        "coarse blurs weigh sensors by the energy of the finest",
    ),
    Mutant(
        "density-pairs-overlap-once",
        "density/overlap.py",
        "+ 2 * cross)",
        "+ cross)",
        "detections side by side have too little energy",
    ),
    Mutant(
        "density-overlap-ends-early",
        "density/overlap.py",
        "REACH = 5.7",
        "REACH = 2.0",
        "bodies of many features have too little energy where features lie close",
    ),
)

_MET = (
    Mutant(
        "density-detection-met-twice",
        "density/features_met.py",
        "if i not in met and j not in taken:",
        "if i not in met:",
        "one detection is taken for several features, hidden ones count as seen",
    ),
    Mutant(
        "density-farthest-detection-met",
        "density/features_met.py",
        'np.argsort(squared[near_i, near_j], kind="stable")',
        'np.argsort(-squared[near_i, near_j], kind="stable")',
        "features take the detection of their neighbour",
    ),
    Mutant(
        "density-hidden-beside-seen-is-a-pair",
        "density/features_met.py",
        "if not near[k] or closer[k] >= 0:",
        "if not near[k]:",
        "a hidden feature beside a seen one counts as merged with it",
    ),
    Mutant(
        "density-merged-detection-counts-twice",
        "density/features_met.py",
        "shares[pair] = weights[pair] / 2",
        "shares[pair] = weights[pair]",
        "two features that share a detection count as two measurements",
    ),
    Mutant(
        "density-merged-detection-shared-by-three",
        "density/features_met.py",
        "single[pair[1]] = False",
        "single[pair[1]] = True",
        "a third feature takes a detection that two share already",
    ),
    Mutant(
        "density-neighbours-pull-taken-for-misfit",
        "density/features_met.py",
        "pull = sampled[:, 1:] - amplitude * predicted_gradient",
        "pull = sampled[:, 1:]",
        "features of grey values that overlap seem to be off where they fit",
    ),
    Mutant(
        "density-crowd-of-the-whole-image",
        "density/features_met.py",
        "return count, max(overall, found / _area(2 * half, smallest))",
        "return count, overall",
        "a crowd of false detections around the body counts as rare",
    ),
    Mutant(
        "density-crowd-constant",
        "density/features_met.py",
        "return count, max(overall, found / _area(2 * half, smallest))",
        "return count, 1e-6",
        "clutter does not make a pose less sure",
    ),
    Mutant(
        "density-surplus-within-the-body-only",
        "density/features_met.py",
        "half = (far - near) / 2 + rules.slip * float((far - near).max())",
        "half = (far - near) / 2",
        "detections beside a slipped grid go unnoticed",
    ),
    Mutant(
        "density-surplus-with-those-met",
        "density/features_met.py",
        "half) - met, 0.0)",
        "half), 0.0)",
        "every frame with a missed feature looks like a slip",
    ),
)

_PROJECTION = (
    Mutant(
        "objective-turn-about-x-of-the-other-sign",
        "objective/projection.py",
        "J[..., 3] = y * c - z * b",
        "J[..., 3] = z * b - y * c",
        "steps about x turn the wrong way",
    ),
    Mutant(
        "objective-averted-features-expected",
        "objective/projection.py",
        "seen &= faced",
        "seen &= np.ones_like(faced)",
        "features on the back of a body are missed in every frame",
    ),
    Mutant(
        "objective-hidden-features-weigh",
        "objective/projection.py",
        "self._weights * seen)",
        "self._weights * np.ones_like(seen))",
        "features out of view make a pose worse",
    ),
)

_KERNEL = (
    Mutant(
        "objective-overlap-pushes-instead-of-pulling",
        "objective/kernel.py",
        "rest - amplitude[..., None] * half",
        "rest + amplitude[..., None] * half",
        "the gradient is wrong where features overlap",
    ),
    Mutant(
        "objective-overlap-counted-twice",
        "objective/kernel.py",
        "half = -(scaled[:, :, None] @ (along_i - along_j))",
        "half = -2 * (scaled[:, :, None] @ (along_i - along_j))",
        "the gradient is wrong where features overlap",
    ),
    Mutant(
        "objective-curvature-of-half-the-pairs",
        "objective/kernel.py",
        "return half, gram + cross + cross.swapaxes(2, 3)",
        "return half, gram + cross",
        "steps are too long or too short where features overlap",
    ),
    Mutant(
        "objective-curvature-with-the-amplitude",
        "objective/kernel.py",
        "(level * (gram - outer))",
        "(level * gram)",
        "steps are too short where features overlap",
    ),
    Mutant(
        "objective-overlap-ends-early",
        "objective/kernel.py",
        "_NEGLIGIBLE = -16.0",
        "_NEGLIGIBLE = -1.0",
        "overlaps of features more than 1.4 standard deviations apart are left out",
    ),
    Mutant(
        "objective-neighbours-taken-for-apart",
        "objective/kernel.py",
        "np.count_nonzero(close) <= L * H * n)",
        "np.count_nonzero(close) <= 2 * L * H * n)",
        "a body with some features close together is fitted as if they were apart",
    ),
    Mutant(
        "objective-gradient-of-the-other-sign",
        "objective/kernel.py",
        "(strength[..., None] * rest).sum(axis=0)",
        "(-strength[..., None] * rest).sum(axis=0)",
        "ascents go down",
    ),
    Mutant(
        "objective-curvature-without-variance",
        "objective/kernel.py",
        "drawn = (strength / variances)[..., None] * C",
        "drawn = strength[..., None] * C",
        "steps depend on the unit of lengths",
    ),
)

_MATCHED = (
    Mutant(
        "objective-sensors-weigh-alike",
        "objective/matched.py",
        "weights = tops / energies / len(body)",
        "weights = np.ones(len(views))",
        "clutter in one sensor takes the weight from its true features",
    ),
    Mutant(
        "objective-out-of-the-picture-is-free",
        "objective/matched.py",
        "norm = norm + self.tops * (hidden**2).sum(axis=2)",
        "norm = norm + 0.0 * (hidden**2).sum(axis=2)",
        "a pose gains by moving features that meet nothing out of the picture",
    ),
    Mutant(
        "objective-norm-as-narrow-as-a-feature",
        "objective/matched.py",
        "variances = 2 * np.square(sigmas)",
        "variances = np.square(sigmas)",
        "observed and predicted densities are not of one width",
    ),
    Mutant(
        "objective-last-digits-drawn-coarsely",
        "objective/matched.py",
        "FINE_STEPS = 48.0",
        "FINE_STEPS = 2.0",
        "poses of grey values stop where the look-up is too coarse",
        ("test_fit*.py",),
    ),
    Mutant(
        "objective-ends-on-coarse-cells",
        "objective/matched.py",
        "STEPS_PER_SIGMA = 4.0",
        "STEPS_PER_SIGMA = 1.0",
        "estimates end on cells as large as a feature",
        ("test_fit*.py",),
    ),
)

_SAMPLED = (
    Mutant(
        "objective-left-of-the-image-is-seen",
        "objective/index_maps.py",
        "maps[~((maps >= low) & (maps <= high))] = FAR",
        "maps[~(maps <= high)] = FAR",
        "what a sensor cannot measure counts as measured",
    ),
    Mutant(
        "objective-gravity-left-out",
        "objective/index_maps.py",
        "in_world[3, 3] = P[:, :3]",
        "in_world[3, 3] = 0 * P[:, :3]",
        "a body that sags is expected where it would be without weight",
    ),
    Mutant(
        "objective-filling-samples-count",
        "objective/paper.py",
        "by_pose = blocks.reshape(count, -1)[:, :size]",
        "by_pose = blocks.reshape(count, -1)",
        "the last sample of a body counts several times",
    ),
    Mutant(
        "objective-sensors-added",
        "objective/paper.py",
        "product *= g",
        "product += g",
        "formula (4) is another one",
    ),
    Mutant(
        "objective-gradient-without-the-other-sensors",
        "objective/paper.py",
        "gradient += rest @ part.by_pose",
        "gradient += part.by_pose.sum(axis=0)",
        "steps of formula (4) go by sensors one by one",
    ),
)

_ERRORS = (
    Mutant(
        "density-errors-cut-by-the-blur",
        "density/extraction_error.py",
        "factor = 1 / (1 - np.minimum(0.5 * q / blurs**2, 0.5))",
        "factor = np.ones(count)",
        "the noise seems smaller than it is",
    ),
    Mutant(
        "density-errors-of-all-detections-alike",
        "density/extraction_error.py",
        "weights = shares * np.exp(-0.25 * squared / blurs[sensor] ** 2)",
        "weights = shares",
        "a cut spot is noise of all others",
    ),
    Mutant(
        "density-errors-of-a-frame-forgotten",
        "density/extraction_error.py",
        "np.maximum(variances, pooled(own, rules, 0.0))",
        "variances.copy()",
        "a frame that is not like those before it is looked at too narrowly",
    ),
    Mutant(
        "density-errors-from-above-only",
        "density/extraction_error.py",
        "return max(seen, narrow, key=lambda one: one.log_likelihood)",
        "return seen",
        "where half of the spots are merged all offsets are noise",
    ),
    Mutant(
        "density-errors-each-sensor-for-itself",
        "density/extraction_error.py",
        "wide += rules.shared *",
        "wide += 0.0 *",
        "sensors weigh by their own noise alone",
    ),
)

MUTANTS = (*_ATLAS, *_ERRORS, *_BLUR, *_MET, *_PROJECTION, *_KERNEL, *_MATCHED, *_SAMPLED)

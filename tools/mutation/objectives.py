"""Mutants of `objective`."""

from __future__ import annotations

from mutation.mutant import Mutant

_PROJECTION = (
    Mutant(
        "objective-turn-about-x-of-the-other-sign",
        "objective/projection.py",
        "cross(arms[..., None, :], by_world, axis=-1)",
        "cross(arms[..., None, :], by_world, axis=-1) * [-1, 1, 1]",
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
        "objective/matched.py",
        "gradient[near] -= ",
        "gradient[near] += ",
        "the gradient is wrong where features overlap",
    ),
    Mutant(
        "objective-overlap-counted-twice",
        "objective/matched.py",
        "gradient[near] -= (level * half).sum(axis=0)",
        "gradient[near] -= 2 * (level * half).sum(axis=0)",
        "the gradient is wrong where features overlap",
    ),
    Mutant(
        "objective-curvature-of-half-the-pairs",
        "objective/matched.py",
        "gram += cross + cross.swapaxes(2, 3)",
        "gram += cross",
        "steps are too long or too short where features overlap",
    ),
    Mutant(
        "objective-curvature-with-the-amplitude",
        "objective/matched.py",
        "(gram - outer)",
        "gram",
        "steps are too short where features overlap",
    ),
    Mutant(
        "objective-overlap-ends-early",
        "objective/matched.py",
        "exponents > -DRAWING.negligible",
        "exponents > -1.0",
        "overlaps of features more than 1.4 standard deviations apart are left out",
    ),
    Mutant(
        "objective-neighbours-taken-for-apart",
        "objective/matched.py",
        "not np.count_nonzero(overlap)",
        "not overlap.all()",
        "a body with some features close together is fitted as if they were apart",
    ),
    Mutant(
        "objective-gradient-of-the-other-sign",
        "objective/matched.py",
        "(strength[..., None] * product_gradient).sum(axis=0)",
        "(-strength[..., None] * product_gradient).sum(axis=0)",
        "ascents go down",
    ),
    Mutant(
        "objective-curvature-without-variance",
        "objective/matched.py",
        "drawn = (strength / variances)[..., None] * ",
        "drawn = strength[..., None] * ",
        "steps depend on the unit of lengths",
    ),
)

_MATCHED = (
    Mutant(
        "objective-sensors-weigh-alike",
        "objective/matched.py",
        "weights = tops / energies / len(body.features)",
        "weights = np.ones(len(views))",
        "clutter in one sensor takes the weight from its true features",
    ),
    Mutant(
        "objective-out-of-the-picture-is-free",
        "objective/matched.py",
        "(match.norm + self.tops * np.vecdot(hidden, hidden))",
        "(match.norm + 0.0 * np.vecdot(hidden, hidden))",
        "a pose gains by moving features that meet nothing out of the picture",
    ),
    Mutant(
        "objective-norm-as-narrow-as-a-feature",
        "objective/matched.py",
        "[[2 * sigma * sigma] for sigma in sigmas]",
        "[[sigma * sigma] for sigma in sigmas]",
        "observed and predicted densities are not of one width",
    ),
    Mutant(
        "objective-last-digits-drawn-coarsely",
        "objective/matched.py",
        "= DRAWING.steps_per_sigma, DRAWING.fine_steps",
        "= DRAWING.steps_per_sigma, 2.0",
        "poses of grey values stop where the look-up is too coarse",
        ("test_fit*.py",),
    ),
    Mutant(
        "objective-ends-on-coarse-cells",
        "objective/matched.py",
        "= DRAWING.steps_per_sigma, DRAWING.fine_steps",
        "= 1.0, DRAWING.fine_steps",
        "estimates end on cells as large as a feature",
        ("test_fit*.py",),
    ),
)

_SAMPLED = (
    Mutant(
        "objective-sampled-needs-a-view",
        "objective/paper.py",
        "if not self.terms:  # no sensor has the body in view",
        "if False:",
        "a body that swings out of view ends in a traceback",
        ("test_objective.py",),
    ),
    Mutant(
        "objective-gravity-of-another-seed",
        "objective/paper.py",
        "body.world_offsets(samples.shape[1], seed=seed)",
        "body.world_offsets(samples.shape[1])",
        "with another seed features sag at random",
        ("test_objective.py",),
    ),
    Mutant(
        "objective-left-of-the-image-is-seen",
        "objective/paper.py",
        "maps[~((maps >= lower) & (maps <= upper))] = DRAWING.far",
        "maps[~(maps <= upper)] = DRAWING.far",
        "what a sensor cannot measure counts as measured",
    ),
    Mutant(
        "objective-gravity-left-out",
        "objective/paper.py",
        "by_pose[3, 3, :, 4:] = P[:, :3]",
        "by_pose[3, 3, :, 4:] = 0 * P[:, :3]",
        "a body that sags is expected where it would be without weight",
    ),
    Mutant(
        "objective-sensors-added",
        "objective/paper.py",
        "product *= part",
        "product += part",
        "formula (4) is another one",
    ),
    Mutant(
        "objective-gradient-without-the-other-sensors",
        "objective/paper.py",
        '"s,sm,smk->k", product, g',
        '"s,sm,smk->k", np.ones(count), g',
        "steps of formula (4) go by sensors one by one",
    ),
)

MUTANTS = (*_PROJECTION, *_KERNEL, *_MATCHED, *_SAMPLED)

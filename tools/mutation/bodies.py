"""Mutants of `body` and `optimise`."""

from __future__ import annotations

from mutation.mutant import Mutant

_BODY = (
    Mutant(
        "body-mirror-images-are-of-points",
        "body/look_alikes.py",
        "return replace(body, features=",
        'return replace(body, shape="point", radii=None, features=',
        "mirrored spheres are predicted a tenth of a pixel off",
        ("test_body.py",),
    ),
    Mutant(
        "body-symmetric-on-average",
        "body/symmetry.py",
        "if one_to_one and distance.max() <= tolerance",
        "if one_to_one and distance.mean() <= tolerance",
        "a marker moved on purpose to break a symmetry is overlooked",
    ),
    Mutant(
        "body-normals-not-turned",
        "body/symmetry.py",
        "((normals @ T[:3, :3].T) * normals[image])",
        "(normals * normals[image])",
        "a board seen from behind counts as the same as from the front",
    ),
    Mutant(
        "body-one-normal-is-enough",
        "body/symmetry.py",
        "sum(axis=1).min() > SAME_NORMAL",
        "sum(axis=1).max() > SAME_NORMAL",
        "a symmetry holds though most normals are turned",
    ),
    Mutant(
        "body-symmetry-without-spread",
        "body/model.py",
        "max(symmetry.default_tolerance(points), self._widest)",
        "symmetry.default_tolerance(points)",
        "poses that the spread of the features hides are not known as alike",
    ),
    Mutant(
        "body-samples-not-mirrored",
        "body/features.py",
        "np.concatenate([points, 1.0 - points])",
        "np.concatenate([points, points])",
        "the mean of the samples is off its feature",
    ),
    Mutant(
        "body-box-of-half-the-width",
        "body/features.py",
        "np.sqrt(12.0)",
        "np.sqrt(3.0)",
        "a uniform spread is half as wide as stated",
    ),
    Mutant(
        "body-variance-for-deviation",
        "body/features.py",
        "vectors * np.sqrt(np.maximum(values, 0.0))",
        "vectors * np.maximum(values, 0.0)",
        "samples are spread by the variance in place of the deviation",
    ),
    Mutant(
        "body-nodes-at-the-beginnings",
        "body/features.py",
        "(np.arange(SEGMENT_NODES) + 0.5)[:, None]",
        "np.arange(SEGMENT_NODES)[:, None]",
        "a line is shifted by half a piece",
    ),
    Mutant(
        "body-radius-from-the-origin",
        "body/model.py",
        "away = self.nodes.points - self.means.mean(axis=0)",
        "away = self.nodes.points",
        "a body measured from afar counts as large, and so do all lengths that follow from it",
    ),
    Mutant(
        "body-least-spread",
        "body/model.py",
        "np.linalg.eigvalsh(self.covariances).max()",
        "np.linalg.eigvalsh(self.covariances).min()",
        "features that are uncertain in one direction count as exact",
    ),
    Mutant(
        "body-gravity-of-any-length",
        "body/model.py",
        "np.asarray(direction / np.linalg.norm(direction))",
        "np.asarray(direction)",
        "the length of the direction scales the displacement",
    ),
    Mutant(
        "body-gravity-widens-nothing",
        "body/model.py",
        "else spreads + self.gravity.covariance",
        "else spreads + 0 * self.gravity.covariance",
        "a body that sags is judged as if it were rigid",
    ),
    Mutant(
        "body-gravity-by-the-place-along-a-line",
        "body/model.py",
        "seed=seed)[:, 4]",
        "seed=seed)[:, 3]",
        "a displacement along gravity goes with the place along a line",
    ),
    Mutant(
        "body-exact-in-spite-of-gravity",
        "body/model.py",
        "return sharp and self.gravity is None",
        "return sharp",
        "the displacement along gravity is left out",
    ),
    Mutant(
        "body-fresh-offsets-are-common",
        "body/model.py",
        "seed=seed + 7919 * i)",
        "seed=seed)",
        "samples that should be independent are the same",
    ),
)

_OPTIMISE = (
    Mutant(
        "optimise-curvature-as-told",
        "optimise/ascent.py",
        "for step, change in self._changes[k]:",
        "for step, change in self._changes[k][:0]:",
        "where offsets are as large as the blur, steps get ever smaller",
    ),
    Mutant(
        "optimise-as-flat-as-gradients-show",
        "optimise/ascent.py",
        "share = min((1 - self._options.least_seen) * along / max(along - shown, _TINY), 1.0)",
        "share = 1.0",
        "where a gradient hardly falls the next step leads anywhere",
    ),
    Mutant(
        "optimise-accepts-what-is-worse",
        "optimise/ascent.py",
        "is_better = new_values[row] > values[k] or",
        "is_better = new_values[row] < values[k] or",
        "the ascent goes down",
    ),
    Mutant(
        "optimise-damps-less-after-failure",
        "optimise/ascent.py",
        "max(10 * self._damping[k], 100 * options.damping)",
        "max(0.1 * self._damping[k], 100 * options.damping)",
        "a step that led astray is tried again for ever",
    ),
    Mutant(
        "optimise-gain-without-curvature",
        "optimise/ascent.py",
        "float(step @ (g - 0.5 * (C @ step)))",
        "float(step @ g)",
        "the value at the end is more than the function has",
    ),
    Mutant(
        "optimise-any-hessian",
        "optimise/ascent.py",
        "dpotrf(matrix)[1] == 0 for matrix",
        "True for matrix",
        "where the Hessian is not definite the step leads to a saddle or a minimum",
    ),
    Mutant(
        "optimise-no-hessian",
        "optimise/ascent.py",
        "np.where(np.array(definite)[:, None, None], hessian, C)",
        "1.0 * C",
        "more evaluations than Newton's method needs",
    ),
    Mutant(
        "optimise-every-last-step-taken",
        "optimise/ascent.py",
        "self._is_taken = [False] * count",
        "self._is_taken = [True] * count",
        "an ascent that ran out of iterations takes a step that nobody looked at",
    ),
    Mutant(
        "optimise-flat-directions-are-singular",
        "optimise/ascent.py",
        "_TINY + max(diagonal.tolist()) * 1e-12 * damping",
        "0.0",
        "a direction without curvature ends the run with an error",
    ),
    Mutant(
        "optimise-last-step-not-taken",
        "optimise/ascent.py",
        "self._is_taken[k] = True",
        "self._is_taken[k] = False",
        "the state is a step short of the maximum",
    ),
)

MUTANTS = (*_BODY, *_OPTIMISE)

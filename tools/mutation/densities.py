"""Mutants of `density`."""

from __future__ import annotations

from mutation.mutant import Mutant

_ATLAS = (
    Mutant(
        "density-a-tile-for-each-of-many-places",
        "density/atlas.py",
        "places > planes * self._most_pages",
        "places < 0",
        "a sheet of hundreds of dots takes ten times as long at wide blurs",
    ),
    Mutant(
        "density-second-detection-of-a-tile-lost",
        "density/atlas.py",
        "place = np.arange(len(of)) - of.searchsorted(of)",
        "place = np.zeros_like(of)",
        "of two detections on one tile only one is there",
    ),
    Mutant(
        "density-drawn-too-narrowly",
        "density/atlas.py",
        "reach=DRAWING.reach * n",
        "reach=2.5 * n",
        "features four widths apart draw each other",
    ),
    Mutant(
        "density-normalised-by-two-pi",
        "density/atlas.py",
        "(math.sqrt(2 * np.pi) * w) ** -m",
        "(2 * np.pi * w) ** -m",
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
        "drawn = math.sqrt(n**2 - 1 / 4)",
        "drawn = n",
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
        "offsets += 0.25",
        "offsets *= 0.0",
        "places of features are drawn to cells",
    ),
    Mutant(
        "density-tiles-that-are-left",
        "density/atlas.py",
        "> 0.5 * self.tile",
        "> 2.0 * self.tile",
        "a fit that goes on by some pixels looks up what another feature has",
    ),
    Mutant(
        "density-pages-begin-anywhere",
        "density/atlas.py",
        "_origin = page * np.floor((lower - (reach + page + 0.5)) / page)",
        "_origin = lower - (reach + page + 0.5)",
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
        "remaining = np.sqrt(max(sigma**2 - (step**2 - pattern.step**2) / 6, 0.0))",
        "remaining = sigma",
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
        "density/observation.py",
        "+ 2 * (weights[i]",
        "+ (weights[i]",
        "detections side by side have too little energy",
    ),
    Mutant(
        "density-overlap-ends-early",
        "density/observation.py",
        "np.sqrt(2 * DRAWING.negligible * variances)",
        "2.0 * np.sqrt(variances)",
        "bodies of many features have too little energy where features lie close",
    ),
)

MUTANTS = (*_ATLAS, *_BLUR)

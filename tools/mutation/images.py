"""Mutants of what finds features in images: `extraction`."""

from __future__ import annotations

from mutation.mutant import Mutant

_METHODS = "test_extraction_methods.py"
_BLOBS = "test_extraction_blobs.py"
_CORNERS = "test_extraction_corners.py"

_LEVELS = (
    Mutant(
        "extraction-cut-disks-are-whole",
        "extraction/blobs.py",
        "rim.coverage < rules.whole or rim.residual > rules.exact * residual",
        "rim.coverage < 0",
        "what is cut counts as much as what is whole",
        ("test_extraction_deviations.py",),
    ),
    Mutant(
        "extraction-oblique-disks-are-cut",
        "extraction/blobs.py",
        "longer = blob.length / typical[0] - 1 - rules.rough / radius**1.5",
        "longer = blob.length - 1 - rules.rough / radius**1.5",
        "spots seen aslant count little",
        ("test_extraction_deviations.py",),
    ),
    Mutant(
        "extraction-slivers-are-whole",
        "extraction/blobs.py",
        "longer = blob.length / typical[0] - 1 - rules.rough / radius**1.5",
        "longer = 0.0",
        "what is left of a small spot counts as much as a whole one",
        ("test_extraction_deviations.py",),
    ),
    Mutant(
        "extraction-broken-level-rounded-up",
        "extraction/threshold.py",
        "whole = math.floor(level)",
        "whole = math.ceil(level)",
        "a pixel of grey 101 is not above a level of 100.5",
        (_METHODS,),
    ),
    Mutant(
        "extraction-dark-level-not-turned-over",
        "extraction/threshold.py",
        "threshold = highest - threshold",
        "threshold = 1 * threshold",
        "the grey level for dark features counts from the wrong end",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-dark-is-bright",
        "extraction/threshold.py",
        'if options.polarity == "bright":',
        'if options.polarity != "":',
        "dark features are not found",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-a-hot-pixel-is-the-peak",
        "extraction/threshold.py",
        "cv2.min(rows[:, :-1], rows[:, 1:]).max()",
        "rows.max()",
        "a hot pixel hides the dim features of a frame",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-intensity-with-background",
        "extraction/threshold.py",
        "signal = grey[rows].astype(np.float32) - np.float32(zero)",
        "signal = grey[rows].astype(np.float32)",
        "features weigh by the background below them",
        (_METHODS,),
    ),
    Mutant(
        "extraction-no-surroundings",
        "extraction/threshold.py",
        "max(side, rules.min_margin) for side in",
        "0 * side for side in",
        "a feature that fills its window is taken for background",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-noise-too-large",
        "extraction/background.py",
        "math.sqrt(math.pi / 2 / 6) * mean",
        "math.sqrt(math.pi / 2) * mean",
        "dim features are taken for noise",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-tiles-one-further",
        "extraction/background.py",
        "shift = (1 - first) * tile",
        "shift = -first * tile",
        "the background under a feature is that of the next tile",
        (_BLOBS,),
    ),
)

_SHAPES = (
    Mutant(
        "extraction-min-area-ignored",
        "extraction/blobs.py",
        "for one, area in both if area >= min_area]",
        "for one, area in both]",
        "specks count as features",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-max-area-ignored",
        "extraction/blobs.py",
        "if blob.area <= largest]",
        "if blob.area]",
        "lamps and windows count as features",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-area-without-its-outline",
        "extraction/contours.py",
        "+ len(contour) / 2 + 1",
        "- len(contour) / 2 + 1",
        "a blob has fewer px of area than it covers",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-cut-at-the-far-borders",
        "extraction/contours.py",
        "u == 0 or v == 0 or u + width == columns or v + height == rows",
        "u == 0 or v == 0",
        "a spot that the right or lower border cuts is found beside its place",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-blobs-in-pixels-of-the-window",
        "extraction/blobs.py",
        "PointPattern(points + window[:2],",
        "PointPattern(points,",
        "features jump when they are looked for around the prediction",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-tips-only",
        "extraction/spots.py",
        "centroid: float = constant(\n        0.1,",
        "centroid: float = constant(\n        0.8,",
        "centres are drawn to the middles of pixels",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-many-spots-swap-u-and-v",
        "extraction/single_spots.py",
        "centres + corners, off",
        "centres + corners[:, ::-1], off",
        "three spots and more are found at mirrored places",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-touching-spots-are-one",
        "extraction/spots.py",
        "long: float = constant(1.35,",
        "long: float = constant(9.0,",
        "two spots that touch are one in their middle",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-rim-turned-the-other-way",
        "extraction/conics.py",
        "turned[..., 0, 1] = -turned[..., 1, 0]",
        "turned[..., 0, 1] = turned[..., 1, 0]",
        "the rim of an oblique disk is looked for in the wrong places",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-scraps-within-disks",
        "extraction/blobs.py",
        "within & (areas < disks.area[near, None])",
        "within & (areas < 0)",
        "the islands in a ring count as features beside it",
        (_BLOBS,),
    ),
    Mutant(
        "extraction-intensity-in-pixels-of-the-window",
        "extraction/intensity.py",
        "np.array(window[:2], dtype=np.float64)",
        "np.zeros(2)",
        "grey values jump when they are looked for around the prediction",
        (_METHODS,),
    ),
    Mutant(
        "extraction-window-beyond-the-image",
        "extraction/__init__.py",
        "box = (max(int(u0), 0), max(int(v0), 0),",
        "box = (int(u0), int(v0),",
        "a window that reaches over the border looks at the other end of the image",
        (_BLOBS,),
    ),
)

_SADDLES = (
    Mutant(
        "extraction-corners-move-away",
        "extraction/quadratic.py",
        "np.clip(shift / determinant[:, None], -1, 1)",
        "np.clip(-shift / determinant[:, None], -1, 1)",
        "corners are off by as much again as their first guess",
        (_CORNERS,),
    ),
    Mutant(
        "extraction-corners-of-any-symmetry",
        "extraction/corners.py",
        "crossed &= (crossings == 4) & (symmetry >= rules.symmetry)",
        "crossed &= crossings == 4",
        "crossings of unlike things count as corners",
        (_CORNERS,),
    ),
    Mutant(
        "extraction-corners-of-any-step",
        "extraction/corners.py",
        "crossed & (differences >= threshold)",
        "crossed & (differences >= 0)",
        "the threshold does nothing for corners",
        (_CORNERS,),
    ),
    Mutant(
        "extraction-corners-in-rows-of-the-band",
        "extraction/corners.py",
        "np.stack([u + margin, v + top], axis=-1)",
        "np.stack([u + margin, v], axis=-1)",
        "corners are found in the rows of a band",
        (_CORNERS,),
    ),
)

_SIZES = (
    Mutant(
        "tracking-sizes-of-no-scale",
        "tracking/sizes.py",
        "logs = np.log(pattern.radii / scales)",
        "logs = np.log(pattern.radii)",
        "markers are as large in an image as in space",
        ("test_tracking_sizes.py",),
    ),
    Mutant(
        "tracking-sizes-cut-by-nothing",
        "tracking/sizes.py",
        "(1 - smaller)",
        "0.0 * (1 - smaller)",
        "a sliver is as exact as a disk",
        ("test_tracking_sizes.py",),
    ),
    Mutant(
        "tracking-sizes-learnt-from-slivers",
        "tracking/sizes.py",
        "weights = 1 - known.cut(logs, rules)",
        "weights = np.ones(len(logs))",
        "cut spots make markers small and sizes uncertain",
        ("test_tracking_sizes.py",),
    ),
    Mutant(
        "tracking-sizes-not-of-a-first-frame",
        "tracking/tracker.py",
        "return ranked if data.track.sizes.count else self._by_size(data, ranked)",
        "return ranked",
        "in the first frame slivers are as exact as disks",
        ("test_tracking_sizes.py",),
    ),
)

MUTANTS = (*_LEVELS, *_SHAPES, *_SADDLES, *_SIZES)

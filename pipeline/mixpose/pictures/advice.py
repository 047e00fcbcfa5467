"""Describe detections and expectation of a sensor in words, and advise changes of the session."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.pictures import levels
from mixpose.pictures.finding import Expectation, Finding
from mixpose.pictures.levels import FLOODED, Light, around, change_of, names_of, threshold_for_more
from mixpose.records import GridPattern, PointPattern

_NOTHING_NOISES = 4.0  # noises above the background, below which a place is empty
_LOOSE_RMS = 1.2  # of σ: residuals from which on the session states too small a σ
_SPECK_PX = 2  # pieces up to this area, px, are noise
_MOST = 0.8  # share of features in view that must be met to know what markers look like


def describe(finding: Finding, body: Body, unit: str) -> list[str]:
    """Describe a sensor in lines of text: counts first, then advice; `unit` is of lengths."""
    if finding.frame is None:
        return [f"{finding.name}: no frame of this number"]
    lines = [f"{finding.name}: {_counts(finding, body, unit)}"]
    data, expected = finding.frame.data, finding.expectation
    if expected is not None and _is_without_match(expected):
        lines.append(
            "  it takes no part in this pose, as it meets nothing of it: are its T_sensor_world, "
            "calibration and source right? mixpose check tries others"
        )
        return lines
    if isinstance(data, PointPattern | GridPattern):
        advice = _about_measurements(finding, body)
    else:
        light = Light(data, finding.setup.extract)
        lines.append(_threshold(light))
        if light.options.method in ("blobs", "intensity"):
            advice = _about_spots(finding, light, body)
        else:
            advice = _about_others(finding, body)
    return lines + [f"  {line}" for line in [*advice, *_about_sigma(finding)]]


def _is_without_match(expected: Expectation) -> bool:
    """Test whether a sensor meets no feature, with half as many unexplained detections or more."""
    in_view = int(expected.seen.sum())
    return bool(0 < in_view <= 2 * int(expected.unexplained.sum()) and not expected.met.any())


def _counts(finding: Finding, body: Body, unit: str) -> str:
    """State the numbers of detections and of expected features."""
    unit = "px" if finding.setup.sensor.unit == "px" else unit
    if finding.points is None:
        kind = "echoes" if finding.setup.sensor.dimension == 1 else "light"
        counted = f"{kind} as of {finding.count:.1f} points"
    else:
        counted = f"{finding.count:.0f} feature{'s' * (finding.count != 1)} found"
        counted += ", which are too many to use any" * (finding.passed_over > 0)
    expected = finding.expectation
    if expected is None:
        expects = f"without a pose up to {len(body)} are expected"
        return f"{counted}; {expects if _is_countable(finding, body) else 'there is no pose'}"
    text = f"{counted}; the pose has {int(expected.seen.sum())} of {len(body)} in view"
    text += f", {int(expected.met.sum())} of them met"
    if expected.rms is not None:
        text += f" within {expected.rms:.3g} {unit} RMS"
    return f"{text}; {100 * expected.explained:.0f} % of the density explained"


def _threshold(light: Light) -> str:
    """State the threshold that was used, in grey levels of the image."""
    options = light.options
    if options.method in ("corners", "log"):
        thing, step = "corner", "bright to dark fields"
        if options.method == "log":
            thing, step = "spot", "a spot to what is around it"
        if isinstance(options.threshold, str):
            return f'  threshold "auto": clear of the noise, and a fifth of the clearest {thing}'
        return f"  threshold {options.threshold:g} grey levels from {step}"
    if options.method not in ("blobs", "intensity"):
        return f"  method {options.method} has a threshold of its own"
    scene = light.scene
    side = "above" if options.polarity == "bright" else "below"
    if scene.is_selective:
        heights = scene.level, scene.noise, scene.least_peak
        digits = ".3g" if light.image.dtype == np.float32 else ".1f"
        level, noise, peak = (f"{value:{digits}}" for value in heights)
        text = (
            f'  threshold "{options.threshold}": {level} grey levels {side} the background, whose '
            f"noise is {noise}; peaks of at least {peak}"
        )
    else:
        text = f"  threshold {light.in_image(scene.level):g}, {side} which is feature"
    return f"{text}; {100 * light.share:.2g} % of the pixels"


def _about_spots(finding: Finding, light: Light, body: Body) -> Iterator[str]:
    """Advise on blobs and intensity."""
    options = light.options
    if light.share > FLOODED and finding.points is not None and finding.count > 3 * len(body):
        stricter = change_of(options, lower=False, level=light.formatted(light.level))
        if options.method == "blobs":
            stricter += f", raise min_area = {options.min_area:g} or set max_area"
        yield (
            f"too much of the image counts as feature: {stricter}, or set "
            'threshold = "local" where the light is uneven'
        )
    expected = finding.expectation
    if expected is None or finding.passed_over:
        yield from _about_number(finding, body, light)
        return
    yield from _about_missing(finding, expected, light, body)
    if options.method == "blobs":
        yield from _about_extra(finding, expected, light)


def _about_missing(
    finding: Finding, expected: Expectation, light: Light, body: Body
) -> Iterator[str]:
    """State why expected features were not met, and which change would find them."""
    options = light.options
    missing = _sorted_out(finding, expected, light)
    ground, shine = ("dark", "bright") if options.polarity == "bright" else ("bright", "dark")
    if features := missing["nothing"]:
        yield (
            f"not met and {ground} there: {names_of(features, body)}; hidden, out of light, or the "
            "pose is wrong"
        )
    if features := missing["faint"]:
        level = (min(features.values()) + float(np.median(light.raw))) / 2  # and the background
        lower = levels.lower_level(light, level)
        yield f"not met, fainter than the threshold: {names_of(features, body)}; {lower}"
    if features := missing["small"]:
        lower = change_of(options, lower=True, level=light.formatted(light.level))
        yield (
            f"not met, too small: {names_of(features, body)}; lower min_area = "
            f"{options.min_area:g} to {min(features.values()):g}, or {lower}"
        )
    if features := missing["large"]:
        yield (
            f"not met, too large: {names_of(features, body)}; raise max_area = "
            f"{options.max_area:g} to {max(features.values()):g}"
        )
    if features := missing["other"]:
        yield (
            f"not met though {shine} there: {names_of(features, body)}; they run into something "
            "else, are partly hidden, have no clear shape, or are not where the object says; "
            f"{levels.threshold_apart(finding, expected, light, body, list(features))}"
        )


def _sorted_out(
    finding: Finding, expected: Expectation, light: Light
) -> dict[str, dict[int, float]]:
    """Sort missed features by cause, each with its signal, its peak (if faint) or its area."""
    options, scene = light.options, light.scene
    labels, areas = light.pieces
    kinds: dict[str, dict[int, float]] = {
        kind: {} for kind in ("nothing", "faint", "small", "large", "other")
    }
    for i in np.flatnonzero(expected.seen & ~expected.met).tolist():
        region = around(expected.y[i], levels.NEAR_SIGMAS * finding.sigma, scene.grey.shape)
        signal = float(scene.grey[region].max()) - scene.zero
        area = float(areas[labels[region]].max())
        if signal < min(_NOTHING_NOISES * scene.noise, scene.level):
            kinds["nothing"][i] = signal
        elif signal <= scene.level:
            kinds["faint"][i] = float(light.raw[region].max())
        elif area < options.min_area:
            kinds["small"][i] = area
        elif options.max_area is not None and area > options.max_area:
            kinds["large"][i] = area
        else:
            kinds["other"][i] = area
    return kinds


def _about_extra(finding: Finding, expected: Expectation, light: Light) -> list[str]:
    """Advise how to exclude detections that belong to no feature, by size or brightness."""
    pattern = None if finding.view is None else finding.view.observation.pattern
    if not isinstance(pattern, PointPattern) or not expected.unexplained.any():
        return []
    # for one of several bodies only its unclaimed detections, not all blobs of the image
    regions = [
        around(place, radius, light.raw.shape)
        for place, radius in zip(pattern.points, pattern.radii.tolist(), strict=True)
    ]
    extra = expected.unexplained
    text = f"{int(extra.sum())} found belong to no feature"
    unsure = not expected.is_sure or expected.met.sum() < _MOST * expected.seen.sum()
    if unsure or extra.all():
        # unexplained detections may be the markers
        where = "shows more of the body" if expected.is_sure else "is ok"
        return [f"{text}; which are markers cannot be told here: look at a frame that {where}"]
    labels, areas = light.pieces
    size = np.array([areas[labels[region]].max() for region in regions], dtype=np.float64)
    peak, claimed = np.array([light.raw[region].max() for region in regions]), ~extra
    if size[extra].max() < 0.8 * size[claimed].min():
        middle = np.sqrt(size[extra].max() * size[claimed].min())
        return [f"{text}, all smaller than those that do: raise min_area to {middle:.0f}"]
    if size[extra].min() > 1.25 * size[claimed].max():
        middle = np.sqrt(size[extra].min() * size[claimed].max())
        return [f"{text}, all larger than those that do: set max_area = {middle:.0f}"]
    if peak[extra].max() < peak[claimed].min():
        level = (peak[extra].max() + peak[claimed].min()) / 2
        word = "fainter" if light.options.polarity == "bright" else "less dark"
        text += f", all {word} than those that do; they do no harm"
        number = levels.threshold_without(finding, pattern.points[extra], light, level)
        return [f"{text}, and in this frame {number} would leave them out" if number else text]
    return [f"{text} and look like those that do; clutter is allowed for, or cover it up"]


def _is_countable(finding: Finding, body: Body) -> bool:
    """Test whether counts compare with the number of features: not if lines make more light."""
    are_points = all(isinstance(feature, PointFeature) for feature in body.features)
    return finding.points is not None or are_points


def _about_number(finding: Finding, body: Body, light: Light) -> list[str]:
    """Advise without a pose, by the number of features alone."""
    options = light.options
    if not _is_countable(finding, body):
        return []
    if finding.count < 0.8 * len(body):
        lines = []
        areas = light.pieces[1] if options.method == "blobs" else np.zeros(0, np.int32)
        small = areas[(areas > _SPECK_PX) & (areas < options.min_area)]
        if len(small):
            lines.append(
                f"{len(small)} pieces above the threshold are too small, the largest of "
                f"{small.max()} px: lower min_area = {options.min_area:g}"
            )
        large = areas[areas > (options.max_area or np.inf)]
        if len(large):
            lines.append(
                f"{len(large)} pieces above the threshold are too large, the smallest of "
                f"{large.min()} px: raise max_area = {options.max_area:g}"
            )
        polarity = f'; is polarity = "{options.polarity}" right?' if not finding.count else ""
        return lines or [f"too few: {threshold_for_more(light, len(body))}{polarity}"]
    if finding.count > 3 * len(body):
        return [
            "too many: look which are markers, and whether they differ from the rest in brightness "
            "(threshold) or size (min_area, max_area)"
        ]
    return []


def _about_others(finding: Finding, body: Body) -> Iterator[str]:
    """Advise on corners, unsharp spots and user-defined methods."""
    options = finding.setup.extract
    expected = finding.expectation
    if expected is None or finding.passed_over:
        if not _is_countable(finding, body):
            return
        has_missed, has_extra = finding.count < 0.8 * len(body), finding.count > 3 * len(body)
        missing, extra = "fewer than the object has", "far more than the object has"
    else:
        missed = np.flatnonzero(expected.seen & ~expected.met).tolist()
        has_missed, has_extra = bool(missed), bool(expected.unexplained.any())
        missing = f"not met: {names_of(missed, body)}" if missed else ""
        extra = f"{int(expected.unexplained.sum())} found belong to no feature"
    lower = raised = f"{options.method} does not tell them"
    if options.method in ("corners", "log"):
        lower, raised = (change_of(options, lower=way) for way in (True, False))
    if has_missed:
        yield f"{missing}; hidden, or {lower}"
    if has_extra:
        yield f"{extra}; clutter is allowed for, or {raised}"


def _about_measurements(finding: Finding, body: Body) -> Iterator[str]:
    """Advise on tables of detections and range profiles, which have no threshold."""
    expected = finding.expectation
    if finding.points is None:
        if finding.count > 2 * len(body) and _is_countable(finding, body):
            yield (
                "far more echoes than features: noise fills the profile; take its floor off, or "
                f"raise sigma in {finding.setup.table_of('sigma')}"
            )
    elif expected is not None:
        if missed := np.flatnonzero(expected.seen & ~expected.met).tolist():
            names = names_of(missed, body)
            yield f"not met: {names}; not in the table, or farther off than sigma allows"
        if extra := int(expected.unexplained.sum()):
            yield f"{extra} in the table belong to no feature; clutter is allowed for"


def _about_sigma(finding: Finding) -> Iterator[str]:
    """Advise to raise sigma if residuals are larger than it."""
    expected = finding.expectation
    if expected is None or expected.rms is None or expected.rms < _LOOSE_RMS * finding.sigma:
        return
    if finding.setup.delay or finding.setup.readout:
        yield (
            "met features are off, as the sensor is late or rolling, and the pose is of the "
            "frame's own moment: one frame does not show how it moves; see the residuals of the run"
        )
    else:
        yield (
            f"met features are off by more than sigma = {finding.setup.extract.sigma:g} says: "
            f"raise sigma in {finding.setup.table_of('sigma')} to about {expected.rms:.2g}, where "
            "markers give way on the body set sigma in [object], or check calibration and markers"
        )

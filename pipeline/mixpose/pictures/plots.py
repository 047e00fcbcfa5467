"""Plot range sensors, and the objective along and over directions around a pose; by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, free_mask
from mixpose.objective import View, build_objective, matched_objective, pose_jacobian
from mixpose.pictures.canvas import Picture
from mixpose.pictures.finding import Finding
from mixpose.pictures.overlay import ellipse_95
from mixpose.pictures.scene import half_widths_95
from mixpose.records import Estimate, Floats, GridPattern, PointPattern
from mixpose.rigid import TWIST_NAMES, perturb, transform

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 100
_MEASURED, _EXPECTED = "#1f6fb4", "#2a9134"
_AROUND = 0.6  # margin around the expected ranges, by their extent
_LEAST_AROUND = 6.0  # least margin, in σ
_PLACES = 600  # number of ranges at which C is drawn
_WIDE = 1.5  # half-width of a slice, in widest blurs
_NARROW = 5.0  # half-width of a map, in finest blurs
_LEAST_WIDE = 8.0  # least half-width of a slice, in finest blurs
_POINTS = 241  # of a slice
_SIDE = 41  # points along a side of a map
_MAPS = 3
_BATCH = 512  # poses that are projected at once
_APART = 0.01  # of a plot's width: least distance between names of features
_SAMPLES = 200  # at most, per feature: enough for a plot


def ranges_picture(
    findings: Sequence[Finding],
    sigmas: Sequence[Sequence[float]],
    body: Body,
    estimate: Estimate,
    unit: str,
    width: int,
    row_height: int,
) -> Picture:
    """Plot range sensors in rows: measurements, densities g and C, the ranges of the pose.

    `sigmas` are the blurs of g per sensor, coarse to fine; `unit` is of lengths, `row_height` that
    of a sensor in px.
    """
    figure = _figure(width, row_height * len(findings))
    rows = figure.subplots(len(findings), 1, squeeze=False)[:, 0]
    for axes, finding, blurs in zip(rows, findings, sigmas, strict=True):
        _plot_ranges(axes, finding, blurs, body, estimate)
    rows[-1].set_xlabel(f"range, {unit}")
    return _raster(figure)


def objective_picture(
    slices: Sequence[Slice],
    maps: Sequence[Map],
    levels: Sequence[float],
    covariance: Floats | None,
    unit: str,
    width: int,
) -> Picture:
    """Plot slices and maps of `objective_around` into a picture of a width in px.

    `levels` are the blurs in σ_ε; 95 % ellipses of the covariance (6, 6) are drawn on the maps;
    `unit` is of lengths.
    """
    import matplotlib as mpl  # noqa: PLC0415 - heavy

    heights = [290, 470] if maps else [290]
    figure = _figure(width, sum(heights))
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    rows = parts[0].subplots(1, max(len(slices), 3), squeeze=False)[0]
    colours = mpl.colormaps["viridis"](np.linspace(0.9, 0.0, len(levels)))
    for axes in rows[len(slices) :]:
        axes.set_axis_off()
    for k, (axes, cut) in enumerate(zip(rows, slices, strict=False)):
        for values, colour, level in zip(cut.values, colours, levels, strict=True):
            label = "σ" if abs(level - 1) < 0.001 else f"{level:.2g} σ"
            axes.plot(_shown(cut.offsets, cut.direction), values, color=colour, label=label)
        axes.axvline(0, color="0.6", lw=0.8, ls=":")
        axes.set(xlabel=_label(cut.direction, unit), ylim=(0, 1.05))
        axes.locator_params(axis="x", nbins=5)
        if k == 0:
            axes.set_ylabel("objective / its largest")
            axes.legend(fontsize=7, title="blur", title_fontsize=7, loc="upper right")
        else:
            axes.set_yticklabels([])
    if maps:
        for axes, plane in zip(parts[-1].subplots(1, len(maps), squeeze=False)[0], maps):
            _plot_map(axes, plane, covariance, unit)
    return _raster(figure)


def _plot_map(axes: Axes, plane: Map, covariance: Floats | None, unit: str) -> None:
    i, j = plane.directions
    across, up = _shown(plane.offsets[0], i), _shown(plane.offsets[1], j)
    axes.contourf(across, up, plane.values, levels=np.linspace(min(plane.values.min(), 0), 1, 21))
    axes.plot(0, 0, "+", color="white", ms=9)
    title = "finest blur"
    if covariance is not None and np.isfinite(covariance).all():
        outline = ellipse_95(covariance[np.ix_([i, j], [i, j])])
        # a round factor that makes it large enough to be seen
        share = max(float(np.abs(outline[:, k]).max() / plane.offsets[k].max()) for k in range(2))
        scale = next((n for n in (1, 2, 5, 10, 20, 50, 100, 200, 500) if n * share >= 0.15), 1000)
        closed = np.vstack([outline, outline[:1]]) * scale
        axes.plot(_shown(closed[:, 0], i), _shown(closed[:, 1], j), color="white", lw=1.2)
        title += "; 95 % ellipse" + (f", {scale} times as large" if scale > 1 else "")
    axes.locator_params(nbins=7)
    axes.set(xlim=across[[0, -1]], ylim=up[[0, -1]])
    axes.set(xlabel=_label(i, unit), ylabel=_label(j, unit))
    axes.set_title(title, fontsize=9)


def _plot_ranges(
    axes: Axes, finding: Finding, blurs: Sequence[float], body: Body, estimate: Estimate
) -> None:
    """Plot a range sensor; curves are divided by their maxima, which the legend states."""
    measured = f"echoes as of {finding.count:.1f} points"
    measured = measured if finding.points is None else f"{len(finding.points)} ranges"
    axes.set_title(f"{finding.name}: {measured}", fontsize=9, loc="left", parse_math=False)
    axes.set(yticks=[], ylim=(-0.03, 1.55))
    if finding.view is None:
        axes.text(0.5, 0.5, "no frame", transform=axes.transAxes, ha="center")
        return
    low, high = _span(finding)
    pattern = finding.view.observation.pattern
    if isinstance(pattern, GridPattern):
        ranges = pattern.origin[0] + pattern.step * np.arange(pattern.values.shape[1])
        inside = (ranges >= low) & (ranges <= high)
        top = max(float(pattern.values[0, inside].max(initial=0)), 1e-30)
        axes.plot(ranges, pattern.values[0] / top, color=_MEASURED, lw=1.2, label="profile")
    elif isinstance(pattern, PointPattern):
        axes.vlines(pattern.points[:, 0], 0, 1, color=_MEASURED, lw=1.5, label="measured")
    if not finding.view.observation.is_empty:
        shades = np.linspace(0.75, 0.35, len(blurs))
        for sigma, shade in zip(blurs, shades, strict=True):
            g = finding.view.observation.density(sigma, (np.array([low]), np.array([high])))
            values, ranges = np.ravel(g.values), g.window.axis(0)
            top = max(float(values.max()), 1e-30)
            look: dict[str, Any] = {"color": str(shade), "alpha": 0.45, "lw": 0}
            label = f"g / {top:.2g}, σ = {sigma:.2g}"
            axes.fill_between(ranges, values / top, label=label, **look)
        # C is g blurred once more, as the matched objective looks it up
        sigma, ranges = blurs[-1], np.linspace(low, high, _PLACES)
        places = np.stack([ranges, np.zeros_like(ranges)], axis=-1)[None, None]
        atlas = matched_objective([finding.view], body, [sigma]).atlas
        values = np.ravel(atlas.look_up(places)[..., 0])
        top = max(float(values.max()), 1e-30)
        label = f"C / {top:.2g}, σ = {sigma:.2g}"
        axes.plot(ranges, values / top, color="black", lw=0.8, ls="--", label=label)
    _plot_expected(axes, finding, body, estimate)
    axes.set_xlim(low, high)
    axes.legend(fontsize=7, loc="upper right")


def _plot_expected(axes: Axes, finding: Finding, body: Body, estimate: Estimate) -> None:
    expected = finding.expectation
    if expected is None or estimate.T_world_object is None:
        return
    sensor, T = finding.setup.sensor, estimate.T_world_object
    spread = half_widths_95(sensor, body, T, estimate.covariance)
    look: dict[str, Any] = {"fmt": "v", "ms": 5, "color": _EXPECTED, "capsize": 2}
    seen = np.flatnonzero(expected.seen)
    for i in seen:
        label = "pose, 95 %" if i == seen[0] else None
        axes.errorbar(float(expected.y[i, 0]), 1.08, xerr=spread[i], label=label, **look)
    order = seen[np.argsort(expected.y[seen, 0])]
    ranges = expected.y[order, 0]
    # features whose names would overlap share one line of names
    near = np.diff(ranges) < _APART * np.ptp(axes.get_xlim())
    for group in np.split(np.arange(len(order)), np.flatnonzero(~near) + 1):
        names = ", ".join(body.labels[i] for i in order[group])
        middle = float(ranges[group].mean()) if len(group) else 0.0
        axes.text(middle, 1.2, names, color=_EXPECTED, ha="center", fontsize=8, parse_math=False)


def _span(finding: Finding) -> tuple[float, float]:
    """Return the shown ranges: around the expected ones, else around all measured ones."""
    shown = np.zeros(0)
    if finding.expectation is not None:
        shown = finding.expectation.y[finding.expectation.seen, 0]
    if not len(shown):
        if finding.view is None or finding.view.observation.is_empty:
            return 0.0, 1.0
        shown = np.concatenate(finding.view.observation.extent)
    margin = max(_AROUND * float(np.ptp(shown)), _LEAST_AROUND * finding.sigma)
    return float(shown.min()) - margin, float(shown.max()) + margin


def _shown(offsets: Floats, direction: int) -> Floats:
    return np.degrees(offsets) if direction >= 3 else offsets


def _label(direction: int, unit: str) -> str:
    return f"{TWIST_NAMES[direction]}, {'deg' if direction >= 3 else unit}"


def _figure(width: int, height: int) -> Figure:
    from matplotlib.figure import Figure  # noqa: PLC0415 - heavy, and an extra

    return Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, layout="constrained")


def _raster(figure: Figure) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return np.ascontiguousarray(rgba[..., 2::-1], dtype=np.uint8)


@dataclass(frozen=True)
class Slice:
    """Values of the objective along one direction."""

    direction: int  # of `mixpose.rigid.TWIST_NAMES`
    offsets: Floats  # (n,) lengths or radians from the pose
    values: Floats  # (levels, n) by blur, divided by the maximum of the level


@dataclass(frozen=True)
class Map:
    """Values of the objective at the finest blur over two directions."""

    directions: tuple[int, int]  # across and up
    offsets: tuple[Floats, Floats]  # (n,), (n,)
    values: Floats  # (n, n) divided by their maximum, rows along the second direction


def objective_around(
    views: Sequence[View],
    body: Body,
    T_world_object: Floats,
    covariance: Floats | None,
    options: EstimatorOptions,
    levels: Sequence[Sequence[float]],
) -> tuple[list[Slice], list[Map]]:
    """Evaluate the objective along all free directions, and over the most correlated pairs.

    There is at least one view, and none with an empty observation. Correlations are those of the
    covariance (6, 6); without it the first pairs are taken. `levels` are the blurs per level and
    view, coarse to fine.
    """
    free = np.flatnonzero(free_mask(options)).tolist()
    unit = _one_blur(views, body, T_world_object, levels[-1])
    widest = max(w / f for w, f in zip(levels[0], levels[-1], strict=True))
    wide = max(_LEAST_WIDE, _WIDE * widest)
    samples = body.sample(min(options.samples, _SAMPLES), seed=options.seed)

    def values(sigmas: Sequence[float], twists: Floats) -> Floats:
        arguments = options.objective, views, body, samples, sigmas, T_world_object, options.seed
        objective = build_objective(*arguments)
        poses = perturb(T_world_object, twists)
        parts = [objective.value(poses[k : k + _BATCH]) for k in range(0, len(poses), _BATCH)]
        heights = np.nan_to_num(np.concatenate(parts))
        return np.asarray(heights / max(float(heights.max()), 1e-300))

    slices, maps = [], []
    for k in free:
        offsets = _half_width(wide * unit[k], k) * np.linspace(-1, 1, _POINTS)
        twists = offsets[:, None] * np.eye(6)[k]
        curves = np.array([values(sigmas, twists) for sigmas in levels])
        slices.append(Slice(k, offsets, curves))
    pairs = list(combinations(free, 2))
    if covariance is not None and np.isfinite(covariance).all():
        deviations = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        related = np.abs(covariance / deviations / deviations[:, None])
        pairs.sort(key=lambda pair: -related[pair])
    for i, j in pairs[:_MAPS]:
        across, up = (_half_width(_NARROW * unit[k], k) * np.linspace(-1, 1, _SIDE) for k in (i, j))
        grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
        surface = values(levels[-1], grid @ np.eye(6)[[i, j]])
        maps.append(Map((i, j), (across, up), surface.reshape(_SIDE, _SIDE)))
    return slices, maps


def _half_width(offset: float, direction: int) -> float:
    """Limit an offset to half a turn if the direction is a rotation."""
    return min(offset, np.pi) if direction >= 3 else offset


def _one_blur(
    views: Sequence[View], body: Body, T_world_object: Floats, sigmas: Sequence[float]
) -> Floats:
    """Return offsets (6,) that move features by the finest blur in the most sensitive sensor."""
    points = body.nodes.points
    keenest = np.zeros(6)
    for view, sigma in zip(views, sigmas, strict=True):
        _, by_world, seen = view.sensor.linearise(transform(T_world_object, points))
        if seen.any():
            J = pose_jacobian(by_world, points @ T_world_object[:3, :3].T)[seen] / sigma
            keenest = np.maximum(keenest, (J**2).sum(axis=1).mean(axis=0))
    usual = np.repeat([0.02 * body.radius, np.radians(1.0)], 3)
    return np.where(keenest > 0, 1 / np.sqrt(np.maximum(keenest, 1e-300)), usual)

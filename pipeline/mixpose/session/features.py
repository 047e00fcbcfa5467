"""From ``[object]`` to the body: points, segments, their spread and their normals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mixpose.body import Body, Feature, Gravity, PointFeature, SegmentFeature
from mixpose.body.features import SEGMENT_NODES
from mixpose.limits import MOST_FEATURES
from mixpose.records import Floats
from mixpose.session.marker_files import Markers, read_marker_file
from mixpose.session.messages import BadKeyError, found, in_file, show, under
from mixpose.session.schema import ObjectTable
from mixpose.session.values import RADIUS_ALLOWED, SIGMA_ALLOWED, is_number, numbers
from mixpose.units import Unit

FEWEST_FEATURES = 3
_SYMMETRY = 1e-6  # rounding of a covariance, relative to its largest entry


def build_body(table: ObjectTable, folder: Path, unit: Unit) -> Body:
    """Build the object model; points come first, then segments.

    The marker file is below `folder`; lengths of other programs' files are converted into `unit`.
    Raises BadKeyError unless there are three features or more, none repeated, that the rest fits.
    """
    markers = _markers(table, folder, unit)
    points = markers.points
    segments = np.zeros((0, 2, 3)) if table.segments is None else table.segments
    count = len(points) + len(segments)
    nodes = len(points) + SEGMENT_NODES * len(segments)
    given = "file" if table.file is not None else "points"
    if nodes > MOST_FEATURES:
        raise BadKeyError(
            f"found {len(points)} points and {len(segments)} segments; allowed: {MOST_FEATURES} "
            f"together, a segment counting as {SEGMENT_NODES}",
            given,
        )
    if count < FEWEST_FEATURES:
        raise BadKeyError(
            f"found {count} feature{'s' * (count != 1)}; allowed: at least three points and "
            "segments together",
            given if table.segments is None else "segments",
        )
    for i, (start, end) in enumerate(segments):
        if np.array_equal(start, end):
            raise BadKeyError(
                "found a segment without length; allowed: two different ends", "segments", i
            )
    places = len(np.unique(np.concatenate([points, segments.mean(axis=1)]), axis=0))
    if places < FEWEST_FEATURES:
        raise BadKeyError(
            f"found {count} features at {places} place{'s' * (places != 1)}; allowed: at least "
            "three features at places of their own",
            given,
        )
    spreads = _spreads(table, markers, count)
    kind = table.spread
    features: list[Feature] = [PointFeature(z, C, kind) for z, C in zip(points, spreads)]
    for (a, b), C in zip(segments, spreads[len(points) :]):
        features.append(SegmentFeature(a, b, C, kind))
    normals = _normals(table, markers, count)
    _refuse_repeated(points, spreads, normals, given)
    radii = _radii(table, normals, len(points), count)
    gravity, names = _gravity(table), _names(table, markers)
    return Body(table.name, tuple(features), normals, gravity, table.shape, radii, names, table.tip)


def _refuse_repeated(points: Floats, spreads: Floats, normals: Floats | None, key: str) -> None:
    """Refuse a point that is there twice: nothing can tell the two from each other."""
    parts = [points, spreads[: len(points)].reshape(-1, 9)]
    parts += [] if normals is None else [normals[: len(points)]]
    rows = np.concatenate(parts, axis=1)
    _, first, back = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    before = first[back.ravel()]
    again = np.flatnonzero(before != np.arange(len(rows)))
    if len(again):
        k = int(again[0])
        raise BadKeyError(
            f"point {k + 1} is where point {before[k] + 1} is, alike in all; allowed: each point "
            "once",
            key,
        )


def _names(table: ObjectTable, markers: Markers) -> tuple[str, ...]:
    """What people call the points; nothing where a file gives some no name, or two the same."""
    given = markers.names if table.names is None else table.names
    names, count = tuple(" ".join(name.split()) for name in given), len(markers.points)
    if table.names is None:
        return names if all(names) and len({*names}) == len(names) == count else ()
    if table.file is not None:
        raise BadKeyError("stands beside file, which has names; allowed: one of the two", "names")
    _require_count(len(names), "names", count, "points", "one per point", "names")
    for i, name in enumerate(names):
        if not name or name in names[:i]:
            raise BadKeyError(found(name, "a name of its own for each point"), "names", i)
    return names


def _radii(table: ObjectTable, normals: Floats | None, points: int, count: int) -> Floats | None:
    """Radii (N,) of spheres or disks, 0 for segments; None for points."""
    if table.shape == "point":
        if table.radius is not None:
            raise BadKeyError(
                'stands beside shape = "point"; allowed: a shape that has one', "radius"
            )
        return None
    if table.radius is None:
        raise BadKeyError(f'missing; shape = "{table.shape}" needs {RADIUS_ALLOWED}', "radius")
    if table.shape == "disk" and normals is None:
        raise BadKeyError('missing; shape = "disk" needs the normal of each disk', "normals")
    with under("radius"):
        given = table.radius if isinstance(table.radius, list) else [table.radius] * points
        own = numbers(given, (None,), RADIUS_ALLOWED)
        _require_count(len(own), "radii", points, "points", RADIUS_ALLOWED)
        if (own <= 0).any():
            raise BadKeyError(f"found {own.min():g}; allowed: {RADIUS_ALLOWED}, greater than 0")
    return np.concatenate([own, np.zeros(count - points)])


def _gravity(table: ObjectTable) -> Gravity | None:
    if table.gravity is None:
        return None
    if not table.gravity.direction.any():
        raise BadKeyError(
            "found a direction without length; allowed: where gravity points in the world",
            "gravity",
            "direction",
        )
    return Gravity(table.gravity.direction, table.gravity.sigma)


def _markers(table: ObjectTable, folder: Path, unit: Unit) -> Markers:
    if table.file is not None:
        if table.points is not None:
            raise BadKeyError("stands beside points; allowed: one of the two", "file")
        with under("file"):
            return read_marker_file(folder / table.file, unit)
    if table.points is None and table.segments is None:
        raise BadKeyError('missing; allowed: points, file = "markers.csv" or segments', "points")
    return Markers(np.zeros((0, 3)) if table.points is None else table.points, None)


def _spreads(table: ObjectTable, markers: Markers, count: int) -> Floats:
    """Covariances (N, 3, 3) of all features."""
    if markers.sigma is None:
        with under("sigma"):
            return covariances(0.0 if table.sigma is None else table.sigma, count)
    if table.sigma is not None:
        raise BadKeyError(f"stands beside the sigma columns of {table.file}; drop one", "sigma")
    with under("file"), in_file(str(table.file)), under("sigma"):
        own = _one_each(markers.sigma)
    # segments have no row in the table: they are exact
    return np.concatenate([own, np.zeros((count - len(own), 3, 3))])


def covariances(sigma: Any, count: int) -> Floats:
    """Read the key ``sigma``, which is `SIGMA_ALLOWED`, as one covariance per feature, (N, 3, 3).

    Where three features leave it open, a list of three numbers is [sx, sy, sz] for all of them, and
    three lists of three numbers are a covariance for all of them.
    """
    if _is_single(sigma):
        _check_ambiguous(sigma, count)
        return np.repeat(_covariance(sigma)[None], count, axis=0)
    if not isinstance(sigma, list) or not sigma:
        raise BadKeyError(found(sigma, SIGMA_ALLOWED))
    _require_count(len(sigma), "items", count, "features", SIGMA_ALLOWED)
    return _one_each(sigma)


def _require_count(own: int, what: str, count: int, of: str, allowed: str, *key: str) -> None:
    if own != count:
        raise BadKeyError(f"found {own} {what} for {count} {of}; allowed: {allowed}", *key)


def _is_single(sigma: Any) -> bool:
    """Whether this is one spread, right or wrong, and not a list with one per feature."""
    if not isinstance(sigma, list):
        return True
    lists = [item for item in sigma if isinstance(item, list)]
    of_numbers = not any(isinstance(x, list) for item in lists for x in item)
    return len(sigma) == 3 and (not lists or (len(lists) == 3 and of_numbers))


def _check_ambiguous(sigma: Any, count: int) -> None:
    """Three times the same [s, s, s] for three features is hardly meant as a covariance."""
    if count != 3 or not isinstance(sigma, list) or not isinstance(sigma[0], list):
        return
    entries = [entry for row in sigma for entry in row]
    if len(entries) == 9 and is_number(entries[0]) and entries == [entries[0]] * 9 != [0] * 9:
        raise BadKeyError(
            f"{show(sigma)} may be a covariance or one [sx, sy, sz] per feature; for the latter "
            f"write sigma = {show(entries[0])}"
        )


def _one_each(sigma: list[Any]) -> Floats:
    spreads = []
    for i, item in enumerate(sigma):
        with under(i):
            spreads.append(_covariance(item))
    return np.array(spreads)


def _covariance(sigma: Any) -> Floats:
    """One spread, in any of its forms, as a covariance (3, 3)."""
    if is_number(sigma):
        sigma = [sigma] * 3
    elif not isinstance(sigma, list):
        raise BadKeyError(found(sigma, SIGMA_ALLOWED))
    if any(isinstance(item, list) for item in sigma):
        return _positive(numbers(sigma, (3, 3), "a 3x3 covariance, [sx, sy, sz] or a number"))
    deviations = numbers(sigma, (3,), "three numbers [sx, sy, sz], a 3x3 covariance or a number")
    if (deviations < 0).any():
        raise BadKeyError(f"found {deviations.min():g}; allowed: at least 0, and 0 for exact")
    return np.diag(deviations**2)


def _positive(covariance: Floats) -> Floats:
    scale = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > _SYMMETRY * scale:
        raise BadKeyError(
            "found a matrix that is not symmetric; allowed: a 3x3 covariance (for one "
            "[sx, sy, sz] per feature of three features, write three covariances)"
        )
    covariance = (covariance + covariance.T) / 2
    smallest = float(np.linalg.eigvalsh(covariance).min())
    if smallest < -_SYMMETRY * scale:
        raise BadKeyError(
            f"found a matrix with the eigenvalue {smallest:.3g}; allowed: a covariance, none of "
            "whose eigenvalues is negative"
        )
    return covariance


def _normals(table: ObjectTable, markers: Markers, count: int) -> Floats | None:
    """Unit normals (N, 3), else those of the marker file where it has all features."""
    normals = table.normals
    if normals is None:
        normals = markers.normals
        if normals is None or len(normals) != count:
            return None
    allowed = "one per feature, points first and then segments"
    _require_count(len(normals), "normals", count, "features", allowed, "normals")
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    for i, length in enumerate(lengths):
        if not length > 0:
            raise BadKeyError("found a normal of length 0; allowed: any other", "normals", i)
    return np.asarray(normals / lengths)

"""Build a body from its ``[object]`` table: points, segments, covariances and normals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mixpose.body import Body, Feature, Gravity, PointFeature, SegmentFeature
from mixpose.body.features import SEGMENT_NODES
from mixpose.limits import MOST_FEATURES
from mixpose.records import Floats
from mixpose.session.marker_files import Markers, read_marker_file
from mixpose.session.messages import BadKeyError, in_file, mismatch, show, under
from mixpose.session.schema import ObjectTable
from mixpose.session.values import RADIUS_ALLOWED, SIGMA_ALLOWED, is_number, numbers
from mixpose.units import Unit

FEWEST_FEATURES = 3
_SYMMETRY = 1e-6  # rounding of a covariance, relative to its largest entry


def build_body(table: ObjectTable, folder: Path, unit: Unit) -> Body:
    """Build the body; its features are the points, then the segments.

    The marker file is relative to `folder`; lengths of other programs' files are converted to
    `unit`. Raises BadKeyError for fewer than three features, copies, or keys that do not fit them.
    """
    markers = _markers(table, folder, unit)
    points = markers.points
    segments = np.zeros((0, 2, 3)) if table.segments is None else table.segments
    count = len(points) + len(segments)
    nodes = len(points) + SEGMENT_NODES * len(segments)
    key = "file" if table.file is not None else "points"
    if nodes > MOST_FEATURES:
        raise BadKeyError(
            f"found {len(points)} points and {len(segments)} segments; allowed: {MOST_FEATURES} "
            f"together, a segment counting as {SEGMENT_NODES}",
            key,
        )
    if count < FEWEST_FEATURES:
        counted = f"{count} feature{'s' * (count != 1)}"
        raise BadKeyError(
            f"found {counted}; allowed: at least three points and segments together",
            key if table.segments is None else "segments",
        )
    for i, (start, end) in enumerate(segments):
        if np.array_equal(start, end):
            text = "found a segment without length; allowed: two different ends"
            raise BadKeyError(text, "segments", i)
    places = len(np.unique(np.concatenate([points, segments.mean(axis=1)]), axis=0))
    if places < FEWEST_FEATURES:
        raise BadKeyError(
            f"found {count} features at {places} place{'s' * (places != 1)}; allowed: at least "
            "three features at places of their own",
            key,
        )
    spreads = _spreads(table, markers, count)
    kind = table.spread
    features: list[Feature] = [PointFeature(z, C, kind) for z, C in zip(points, spreads)]
    for (a, b), C in zip(segments, spreads[len(points) :]):
        features.append(SegmentFeature(a, b, C, kind))
    normals = _normals(table, markers, count)
    _refuse_repeated(points, spreads, normals, key)
    radii = _radii(table, normals, len(points), count)
    gravity, names = _gravity(table), _names(table, markers)
    return Body(table.name, tuple(features), normals, gravity, table.shape, radii, names, table.tip)


def _refuse_repeated(points: Floats, spreads: Floats, normals: Floats | None, key: str) -> None:
    """Refuse two points of the same place, covariance and normal: they cannot be distinguished."""
    parts = [points, spreads[: len(points)].reshape(-1, 9)]
    parts += [] if normals is None else [normals[: len(points)]]
    rows = np.concatenate(parts, axis=1)
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.ravel()]
    copies = np.flatnonzero(original != np.arange(len(rows)))
    if len(copies):
        k = int(copies[0])
        raise BadKeyError(
            f"point {k + 1} is where point {original[k] + 1} is, alike in all; allowed: each point "
            "once",
            key,
        )


def _names(table: ObjectTable, markers: Markers) -> tuple[str, ...]:
    """Return the names of the points; none if a marker file has missing or repeated names."""
    texts = markers.names if table.names is None else table.names
    names, count = tuple(" ".join(text.split()) for text in texts), len(markers.points)
    if table.names is None:
        return names if all(names) and len({*names}) == len(names) == count else ()
    if table.file is not None:
        raise BadKeyError("stands beside file, which has names; allowed: one of the two", "names")
    _require_count(len(names), "names", count, "points", "one per point", "names")
    for i, name in enumerate(names):
        if not name or name in names[:i]:
            raise BadKeyError(mismatch(name, "a name of its own for each point"), "names", i)
    return names


def _radii(table: ObjectTable, normals: Floats | None, points: int, count: int) -> Floats | None:
    """Return radii (N,) of spheres or disks, 0 for segments; None if the shape is a point."""
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
        values = table.radius if isinstance(table.radius, list) else [table.radius] * points
        radii = numbers(values, (None,), RADIUS_ALLOWED)
        _require_count(len(radii), "radii", points, "points", RADIUS_ALLOWED)
        if (radii <= 0).any():
            raise BadKeyError(f"found {radii.min():g}; allowed: {RADIUS_ALLOWED}, greater than 0")
    return np.concatenate([radii, np.zeros(count - points)])


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
    if markers.sigma is None:
        with under("sigma"):
            return covariances(0.0 if table.sigma is None else table.sigma, count)
    if table.sigma is not None:
        raise BadKeyError(f"stands beside the sigma columns of {table.file}; drop one", "sigma")
    with under("file"), in_file(str(table.file)), under("sigma"):
        of_points = _covariances_of(markers.sigma)
    # segments have no row in the table: they are exact
    return np.concatenate([of_points, np.zeros((count - len(of_points), 3, 3))])


def covariances(sigma: Any, count: int) -> Floats:
    """Read the key ``sigma``, which is `SIGMA_ALLOWED`, as covariances (N, 3, 3) of features.

    For three features, which make it ambiguous, a list of three numbers is [sx, sy, sz] of all, and
    three lists of three numbers are a covariance of all.
    """
    if _is_single(sigma):
        _check_ambiguous(sigma, count)
        return np.repeat(_covariance(sigma)[None], count, axis=0)
    if not isinstance(sigma, list) or not sigma:
        raise BadKeyError(mismatch(sigma, SIGMA_ALLOWED))
    _require_count(len(sigma), "items", count, "features", SIGMA_ALLOWED)
    return _covariances_of(sigma)


def _require_count(n: int, what: str, count: int, of: str, allowed: str, *key: str) -> None:
    if n != count:
        raise BadKeyError(f"found {n} {what} for {count} {of}; allowed: {allowed}", *key)


def _is_single(sigma: Any) -> bool:
    """Test whether `sigma` is a single spread, valid or not, rather than a list of them."""
    if not isinstance(sigma, list):
        return True
    lists = [item for item in sigma if isinstance(item, list)]
    are_flat = not any(isinstance(x, list) for item in lists for x in item)
    return len(sigma) == 3 and (not lists or (len(lists) == 3 and are_flat))


def _check_ambiguous(sigma: Any, count: int) -> None:
    """Refuse three times the same [s, s, s] for three features: hardly meant as a covariance."""
    if count != 3 or not isinstance(sigma, list) or not isinstance(sigma[0], list):
        return
    entries = [entry for row in sigma for entry in row]
    if len(entries) == 9 and is_number(entries[0]) and entries == [entries[0]] * 9 != [0] * 9:
        raise BadKeyError(
            f"{show(sigma)} may be a covariance or one [sx, sy, sz] per feature; for the latter "
            f"write sigma = {show(entries[0])}"
        )


def _covariances_of(sigma: list[Any]) -> Floats:
    return np.array([under(i)(_covariance)(item) for i, item in enumerate(sigma)])


def _covariance(sigma: Any) -> Floats:
    """Return the covariance (3, 3) of a single spread in any of its forms."""
    if is_number(sigma):
        sigma = [sigma] * 3
    elif not isinstance(sigma, list):
        raise BadKeyError(mismatch(sigma, SIGMA_ALLOWED))
    if any(isinstance(item, list) for item in sigma):
        return _semidefinite(numbers(sigma, (3, 3), "a 3x3 covariance, [sx, sy, sz] or a number"))
    deviations = numbers(sigma, (3,), "three numbers [sx, sy, sz], a 3x3 covariance or a number")
    if (deviations < 0).any():
        raise BadKeyError(f"found {deviations.min():g}; allowed: at least 0, and 0 for exact")
    return np.diag(deviations**2)


def _semidefinite(covariance: Floats) -> Floats:
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
    """Return unit normals (N, 3) of the table, else of the marker file if it has all features."""
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

"""Poses at which the body looks the same, or nearly so, as at the best pose of the frame.

What is met there may lie like other features of the body: a chessboard of which a rim is hidden
explains what is seen a step of its grid off, too, and one tag of a block explains every other,
turned any way.  And a flat body that is small in an image looks almost the same tilted the other
way.  All of them are rivals: the sum of evidence tells which is right, or that none can tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mixpose.body import LookAlike, like_features, other_tilt, thickness, tolerance_of
from mixpose.judgement import ScoredPose
from mixpose.records import Floats
from mixpose.tracking.likelihood import FrameData, Start


def look_alikes(data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
    """The best pose moved so that about as much is met, and the other tilt of a flat body.

    All of them move alike.  Where the frame before left open which of them is right, motion does
    not tell: it says less of where a body's origin goes the farther that is from its middle.
    """
    kinds = data.rules.look_alikes.kinds
    best = None
    # once more, where what is moved is better and meets more
    for _ in range(2 if "congruent" in kinds else 0):
        if not ranked or ranked[0] is best:
            break
        best = ranked[0]
        yield from _as_evident(data, best)
    if ranked and "tilted" in kinds:
        best = ranked[0]
        close = data.start_uncertainty / data.rules.proposals.narrowing
        for T in _tilted(data, best):
            yield Start(T, close, T_moved=data.moves_alike(best.T_world_object))


def reason(data: FrameData, best: ScoredPose, rivals: Iterable[ScoredPose]) -> str:
    """In words, if one of the rivals is a look-alike of the best pose; else empty."""
    alike = _congruent(data, best)
    if not alike:
        return ""
    T, body = best.T_world_object, data.body
    corners = np.vstack([body.means.T, np.ones(len(body))])
    points = np.array([T @ one.T_body_other for one in alike]) @ corners
    for rival in rivals:
        there = rival.T_world_object @ body.symmetries @ corners
        away = np.abs(points[:, None] - there[None]).max(axis=(2, 3)).min(axis=1)
        if away.min() < data.rules.look_alikes.alike * body.radius:
            return alike[int(away.argmin())].reason
    return ""


def met_features(judged: ScoredPose) -> frozenset[int]:
    """Numbers of the features that any sensor meets."""
    return frozenset(np.flatnonzero(judged.matches.met_by).tolist())


def _congruent(data: FrameData, best: ScoredPose) -> Sequence[LookAlike]:
    """Motions under which what is met at a pose lies like other features of the body."""
    body = data.body
    # single ranges do not say what is met
    if len(body.nodes.points) != len(body) or (best.matches.dimensions == 1).any():
        return ()
    tolerance = tolerance_of(body, body, data.rules.look_alikes.alike)
    return like_features(body, met_features(best), body, tolerance)


def _as_evident(data: FrameData, best: ScoredPose) -> Iterable[Start]:
    """The best pose moved, where as much is met and motion does not tell against it.

    Each feature counts as much as any other evidence: what motion says against a pose must be made
    up for by features that it meets more.
    """
    alike = _congruent(data, best)
    if not alike:
        return
    rules, T = data.rules, best.T_world_object
    poses = np.array([T, *(T @ one.T_body_other for one in alike)])
    met = float(best.matches.met.max())
    # the value grows as the square of the features met
    values = np.sqrt(data.finest.shares(poses, whole=True).sum(axis=0))
    fewer = met * (1 - values[1:] / max(values[0], np.finfo(np.float64).tiny))
    here = data.prior(T).log_density
    for k in np.flatnonzero(fewer < rules.look_alikes.fewer).tolist():
        moved = data.moves_alike(T) if alike[k].is_step else None
        against = here - data.prior(poses[1 + k] if moved is None else moved).log_density
        least = 1 + max(against, 0.0) / np.log(rules.acceptance.rival)
        if fewer[k] < rules.look_alikes.fewer * least:
            yield Start(poses[1 + k], data.close, T_moved=moved)


def _tilted(data: FrameData, best: ScoredPose) -> Iterable[Floats]:
    """The pose (4, 4) tilted the other way, where one camera alone meets a nearly flat body."""
    body, views = data.body, data.views
    if len(views) > 1:
        least = data.rules.acceptance.agreeing
        seen = best.matches
        met = {name for name, share in zip(seen.names, seen.coverage) if share >= least}
        views = [view for view in views if view.name in met]
    if len(views) != 1 or views[0].sensor.dimension != 2 or len(body) < 3:
        return
    if thickness(body) <= data.rules.look_alikes.flat:
        T = best.T_world_object
        middle = T[:3, :3] @ body.means.mean(axis=0) + T[:3, 3]
        yield other_tilt(body, T, views[0].sensor.towards(middle[None])[0])

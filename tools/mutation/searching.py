"""Mutants of `search`, of proposers and of reflections."""

from __future__ import annotations

from mutation.mutant import Mutant

_PROPOSERS = "test_tracking_proposers.py"
_STARTS = "test_tracking_starts.py"

_PROPOSALS = (
    Mutant(
        "tracking-other-tilt-never-tried",
        "tracking/proposers/mirrored.py",
        "return [Start(T_tilted, data.start_uncertainty / data.rules.proposals.narrowing)]",
        "return []",
        "a flat body followed at the wrong tilt stays there",
        (_PROPOSERS,),
    ),
    Mutant(
        "tracking-no-sensor-left-out",
        "tracking/proposers/without_sensor.py",
        "return apart if len(left) >= 2 else []",
        "return []",
        "a camera that was bumped bends the pose",
        (_STARTS,),
    ),
    Mutant(
        "tracking-another-sensor-left-out",
        "tracking/proposers/without_sensor.py",
        "            apart.append(one.name)",
        "            apart.append(others[0].name)",
        "of three cameras a sound one is left out",
        (_STARTS,),
    ),
    Mutant(
        "tracking-sensor-left-out-where-two-are-left",
        "tracking/proposers/without_sensor.py",
        "if not likelihood.knows_detections or len(data.views) < 3:",
        "if not likelihood.knows_detections or len(data.views) < 99:",
        "a camera that was bumped bends the pose",
        (_STARTS,),
    ),
    Mutant(
        "tracking-left-out-for-free",
        "tracking/likelihood.py",
        "unmet=others,",
        "unmet=(),",
        "leaving a sensor out makes a pose better",
        (_STARTS,),
    ),
    Mutant(
        "tracking-merged-pairs-never-mended",
        "tracking/proposers/merged_pair.py",
        "return [] if at is judged else",
        "return [] if at is not judged else",
        "two features seen as one bend the pose",
        (_PROPOSERS,),
    ),
    Mutant(
        "tracking-slips-never-looked-for",
        "tracking/proposers/stepped_aside.py",
        "if one.missed > before.missed + least and one.surplus > before.surplus + least:",
        "if one.missed > before.missed + 1e9 and one.surplus > before.surplus + least:",
        "a chessboard is followed a square off",
        (_STARTS,),
    ),
    Mutant(
        "tracking-slips-along-the-world",
        "tracking/proposers/stepped_aside.py",
        "yield Start(T @ shifted, close)",
        "yield Start(shifted @ T, close)",
        "a chessboard that is turned is followed a square off",
        (_STARTS,),
    ),
    Mutant(
        "tracking-one-branch-followed",
        "tracking/proposers/predicted.py",
        "for one in data.predictions]",
        "for one in data.predictions[:1]]",
        "of two possible poses one is forgotten",
        (_STARTS,),
    ),
    Mutant(
        "tracking-search-of-one-seed",
        "tracking/proposers/searched.py",
        "seed=data.options.seed,",
        "seed=0,",
        "the seed of a session does nothing",
        (_STARTS,),
    ),
    Mutant(
        "tracking-live-search-is-thorough",
        "tracking/proposers/searched.py",
        "budget = data.rules.live if live else data.rules.search",
        "budget = data.rules.search",
        "a live search takes as long as a thorough one",
        (_STARTS,),
    ),
    Mutant(
        "tracking-live-search-begins-anew",
        "tracking/proposers/searched.py",
        "state=data.track.search if live else None)",
        "state=None)",
        "a live search tries the same guesses in every frame",
        (_STARTS,),
    ),
    Mutant(
        "tracking-live-search-forgets",
        "tracking/tracker.py",
        "return track.missed(data.log.state, clutter)",
        "return track.missed(track.search, clutter)",
        "a live search tries the same guesses in every frame",
        (_STARTS,),
    ),
    Mutant(
        "tracking-starts-of-one-seed",
        "tracking/proposers/multistart.py",
        "_twists(uncertainty, rules.drawn, data.options.seed)",
        "_twists(uncertainty, rules.drawn, 0)",
        "the seed of a session does nothing",
        (_STARTS,),
    ),
    Mutant(
        "tracking-starts-side-by-side",
        "tracking/proposers/multistart.py",
        "/ scale) > 1.0 for other in kept):",
        "/ scale) > 0.0 for other in kept):",
        "several starts are about the same",
        (_STARTS,),
    ),
    Mutant(
        "tracking-least-promising-starts",
        "tracking/proposers/multistart.py",
        "for k in np.argsort(scores)[::-1]:",
        "for k in np.argsort(scores):",
        "starts are where nothing is seen",
        (_STARTS,),
    ),
    Mutant(
        "tracking-starts-within-a-sigma",
        "tracking/proposers/multistart.py",
        "(2 * cube - 1) * np.sqrt(3) * uncertainty",
        "(2 * cube - 1) / np.sqrt(3) * uncertainty",
        "starts are drawn from less than the uncertainty",
        (_STARTS,),
    ),
    Mutant(
        "tracking-never-in-doubt",
        "tracking/proposers/doubt.py",
        "return not ranked or not convinces(ranked[0], data.free, data.rules.acceptance)",
        "return not ranked",
        "where a prediction fails nothing else is tried",
        (_STARTS,),
    ),
)

_REFLECTION = (
    Mutant(
        "tracking-mirror-images-pass",
        "tracking/reflection.py",
        "return rival.log_evidence > judged.log_evidence + ",
        "return rival.log_evidence > 1e9 + ",
        "the body in a window is taken for the body",
        ("test_tracking_reflection.py",),
    ),
    Mutant(
        "tracking-mirror-images-are-suspected-everywhere",
        "tracking/reflection.py",
        "return rival.log_evidence > judged.log_evidence + ",
        "return rival.log_evidence > -1e9 + ",
        "a flat body with a hidden marker is never sure",
        ("test_tracking_reflection.py",),
    ),
)

_SEARCH_EVIDENCE = (
    Mutant(
        "search-misses-are-free",
        "search/evidence.py",
        "visible.astype(float), shares, offsets",
        "shares, shares, offsets",
        "a pose that misses half of the body is as good as one that meets it",
        ("test_search_evidence.py",),
    ),
    Mutant(
        "search-errors-count-alike",
        "search/evidence.py",
        "variance /= degrees + spare",
        "variance = np.full(len(poses), 0.04)",
        "a pose met to a tenth of a pixel is hardly better than one met to a pixel",
        ("test_search_evidence.py",),
    ),
    Mutant(
        "search-crowds-are-no-clutter",
        "search/evidence.py",
        "np.maximum(overall, inside / (2 * half).prod(axis=1))",
        "np.full(len(y), overall)",
        "where false detections crowd poses are found by chance",
        ("test_search_evidence.py",),
    ),
)

_SEARCH = (
    Mutant(
        "search-slips-not-tried",
        "search/guesses.py",
        "shifts[:, :3, 3] = body.means[i] - body.means[j]",
        "shifts[:, :3, 3] = 0.0",
        "a chessboard is found a square off",
    ),
    Mutant(
        "search-bright-detections-count-more",
        "search/detections.py",
        "alike = Observation(PointPattern(points, np.ones(len(points))),",
        "alike = Observation(PointPattern(points, 1.0 + np.arange(len(points))),",
        "a bright blob is worth more features than a faint one",
    ),
    Mutant(
        "search-held-shifts-move",
        "search/constraint.py",
        "t = np.where(self.shifts, t, self.T_reference[:3, 3])",
        "t = np.where(True, t, self.T_reference[:3, 3])",
        "directions that are not free change",
    ),
    Mutant(
        "search-points-behind-cameras",
        "search/triangulation.py",
        "good &= ~((a.central & (s <= 0)) | (b.central & (t <= 0)))",
        "good &= ~((a.central & (s <= -1e9)) | (b.central & (t <= -1e9)))",
        "rays that run apart meet behind the cameras",
    ),
    Mutant(
        "search-back-sides-counted",
        "search/inlier_counts.py",
        "met = np.where(image.faced(world, outward), met, 0)",
        "met = np.where(True, met, 0)",
        "a pose seen from behind explains as much as the right one",
    ),
    Mutant(
        "search-symmetric-poses-are-candidates",
        "search/refinement.py",
        "images.append(transform(poses[k] @ body.symmetries, points))",
        "images.append(transform(poses[k][None], points))",
        "candidates are the same pose several times",
    ),
    Mutant(
        "search-peaks-on-the-other-side",
        "search/detections.py",
        "slope = 0.5 * (after - before)",
        "slope = 0.5 * (before - after)",
        "peaks of grey values are up to a pixel off",
    ),
    Mutant(
        "search-triangles-turned-back",
        "search/alignment.py",
        "turned_x, turned_y = c * x_body - s * y_body, s * x_body + c * y_body",
        "turned_x, turned_y = c * x_body + s * y_body, c * y_body - s * x_body",
        "guesses from three points are turned the wrong way",
    ),
    Mutant(
        "search-starts-again-each-frame",
        "search/search.py",
        "return SearchState(k, skipped + batches)",
        "return SearchState(k, 0)",
        "a limited search tries the same guesses in every frame",
    ),
)

MUTANTS = (*_PROPOSALS, *_REFLECTION, *_SEARCH_EVIDENCE, *_SEARCH)

"""Mutants of `search`."""

from __future__ import annotations

from mutation.mutant import Mutant

_SEARCH_EVIDENCE = (
    Mutant(
        "search-misses-are-free",
        "search/poses.py",
        "weights=seen.astype(np.float64)",
        "weights=shares",
        "a pose that misses half of the body is as good as one that meets it",
        ("test_search_evidence.py",),
    ),
    Mutant(
        "search-errors-count-alike",
        "search/poses.py",
        "variances = (degrees * errors.typical**2 + squares) / (degrees + spare)",
        "variances = np.full(spare.shape, 0.04)",
        "a pose met to a tenth of a pixel is hardly better than one met to a pixel",
        ("test_search_evidence.py",),
    ),
    Mutant(
        "search-noise-of-one-camera-is-that-of-all",
        "search/poses.py",
        "odds_of(matches, variances,",
        "odds_of(matches, 0 * variances + variances.max(axis=1)[:, None],",
        "a pose of one camera is doubtful where another meets a few features by chance",
        ("test_search_evidence.py",),
    ),
    Mutant(
        "search-crowds-are-no-clutter",
        "search/poses.py",
        "seen[..., None] & rules.crowded, y, np.nan",
        "seen[..., None] & False, y, np.nan",
        "where false detections crowd poses are found by chance",
        ("test_search_evidence.py",),
    ),
)

_SEARCH = (
    Mutant(
        "search-bright-detections-count-more",
        "search/problem.py",
        "seen = Observation(PointPattern(points, np.ones(len(points))),",
        "seen = Observation(PointPattern(points, 1.0 + np.arange(len(points))),",
        "a bright blob is worth more features than a faint one",
    ),
    Mutant(
        "search-held-shifts-move",
        "search/problem.py",
        "self.free * twist_between(",
        "(self.free | (np.arange(6) < 3)) * twist_between(",
        "directions that are not free change",
    ),
    Mutant(
        "search-points-behind-cameras",
        "search/from_points.py",
        "good &= ~((a.central & (s <= 0)) | (b.central & (t <= 0)))",
        "good &= ~((a.central & (s <= -1e9)) | (b.central & (t <= -1e9)))",
        "rays that run apart meet behind the cameras",
    ),
    Mutant(
        "search-back-sides-counted",
        "search/poses.py",
        "met = np.where((outward * towards).sum(axis=0) > 0, met, 0)",
        "met = np.where(True, met, 0)",
        "a pose seen from behind explains as much as the right one",
    ),
    Mutant(
        "search-symmetric-poses-are-candidates",
        "search/search.py",
        "transform(pose @ self._body.symmetries, means)",
        "transform(pose[None], means)",
        "candidates are the same pose several times",
    ),
    Mutant(
        "search-peaks-on-the-other-side",
        "search/problem.py",
        "slope, bend = 0.5 * (after - before),",
        "slope, bend = 0.5 * (before - after),",
        "peaks of grey values are up to a pixel off",
    ),
    Mutant(
        "search-triangles-turned-back",
        "search/three_points.py",
        "c, s = turn.real, turn.imag",
        "c, s = turn.real, -turn.imag",
        "guesses from three points are turned the wrong way",
    ),
    Mutant(
        "search-guesses-seen-from-behind",
        "search/three_points.py",
        "poses[((outward * away).sum(axis=1) < 0).all(axis=0)]",
        "poses[((outward * away).sum(axis=1) < 0).any(axis=0)]",
        "a search of one camera counts ten times as many guesses as can be",
        ("test_search_p3p.py",),
    ),
    Mutant(
        "search-every-pose-a-candidate",
        "search/search.py",
        "if ranks[k] > least]",
        "if ranks[k] > -np.inf]",
        "poses that the best leaves no chance are fitted",
    ),
    Mutant(
        "search-hopeless-poses-are-candidates",
        "search/search.py",
        "max(ranks[0] - budget.outdone, budget.hopeless)",
        "max(ranks[0] - budget.outdone, -np.inf)",
        "where the body is absent poses are fitted that no fit can save",
        ("test_search_poses.py",),
    ),
    Mutant(
        "search-crowds-drawn-anywhere",
        "search/three_points.py",
        "crowd = crowds[k % len(crowds)]",
        "crowd = M",
        "among many false detections hardly a triple drawn is the body's",
        ("test_search_guesses.py",),
    ),
    Mutant(
        "search-outermost-first-in-crowds",
        "search/three_points.py",
        "if all_tried or budget.crowded * n >= M:",
        "if True:",
        "half of the triples are of detections far apart, which in a crowd are false",
        ("test_search_guesses.py",),
    ),
    Mutant(
        "search-points-of-a-crowd-first",
        "search/from_points.py",
        "place = len(generators) if crowded else 0",
        "place = 0",
        "the first frame of web cams takes a third longer",
        ("test_search_guesses.py",),
    ),
    Mutant(
        "search-starts-again-each-frame",
        "search/search.py",
        "after = SearchState(k, done)",
        "after = SearchState(k, 0)",
        "a limited search tries the same guesses in every frame",
    ),
    Mutant(
        "search-points-that-rays-fix-are-as-vague-as-gates",
        "search/from_points.py",
        "np.clip(budget.by_gap * apart, budget.least_off, 1.0)",
        "np.clip(budget.by_gap * apart, 1.0, 1.0)",
        "of small bodies before cameras side by side no point is within the body",
        ("test_search_triangulation.py",),
    ),
    Mutant(
        "search-points-as-exact-as-rays-happen-to-meet",
        "search/from_points.py",
        "np.clip(budget.by_gap * apart, budget.least_off, 1.0)",
        "np.clip(budget.by_gap * apart, 0.0, 1.0)",
        "where two rays meet by luck their point is taken for exact, and its body is not found",
        ("test_search_triangulation.py",),
    ),
    Mutant(
        "search-half-of-the-body-is-enough-however-far-off",
        "search/search.py",
        "if self._coverage() < budget.convincing and not self._is_close():",
        "if False:",
        "before cameras side by side a body is found turned over, after a few guesses",
        ("test_search_evidence.py",),
    ),
)

MUTANTS = (*_SEARCH_EVIDENCE, *_SEARCH)

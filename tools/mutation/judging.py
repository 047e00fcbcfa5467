"""Mutants of `judgement`."""

from __future__ import annotations

from mutation.mutant import Mutant

_NOISE = (
    Mutant(
        "judgement-few-residuals-are-as-good-as-many",
        "judgement/noise.py",
        "return np.asarray(directions * tail / chdtri(directions, 1 - self.confidence))",
        "return np.ones(np.shape(degrees))",
        "covariances of few features are too small",
    ),
    Mutant(
        "judgement-noise-of-earlier-frames-forgotten",
        "judgement/noise.py",
        "memory: float = constant(0.95,",
        "memory: float = constant(0.0,",
        "covariances change from frame to frame with the residuals of single frames",
    ),
    Mutant(
        "judgement-noise-of-another-kind-joined",
        "judgement/noise.py",
        "ratio /= float(fdtri(degrees, known, model.by_chance))",
        "ratio = 0.0",
        "a frame of large residuals is as sure as those before it",
    ),
    Mutant(
        "judgement-noise-with-the-coordinates-used-up",
        "judgement/noise.py",
        "_level(found, before, count, model, estimate)",
        "_level(found, before, 0, model, None)",
        "noise seems smaller than it is",
    ),
    Mutant(
        "judgement-unknown-noise-is-sigma",
        "judgement/noise.py",
        "0.0 if degrees >= 1 else rules.typical_degrees",
        "0.0",
        "three features in one camera have an exact pose",
    ),
)

_FIELDS = (
    Mutant(
        "judgement-fields-of-a-sensor-are-noise",
        "judgement/noise.py",
        "by_kind[0] * inverse + (drawn * (kinds @ by_kind)) @ drawn.T",
        "by_kind[0] * inverse",
        "a camera that was turned after its calibration leaves the pose as sure as before",
    ),
    Mutant(
        "judgement-what-lasts-is-forgotten",
        "judgement/noise.py",
        "if names in before and before[names].shape == shown.shape:",
        "if False:",
        "what is off by the same in every frame never shows",
    ),
    Mutant(
        "judgement-calibrations-are-exact",
        "judgement/noise.py",
        "covariance[inner] += pulled @ pulled.T",
        "covariance[inner] += 0",
        "a stated error of the focal length leaves the distance as sure as before",
    ),
    Mutant(
        "judgement-markers-off-are-noise",
        "judgement/noise.py",
        "pulls**2 @ kinds[:, 1:]",
        "pulls**2 @ kinds[:, 1:] * [1, 1, 0]",
        "sensors that see a marker off in the same way count as independent",
    ),
    Mutant(
        "judgement-share-of-fields-forgotten",
        "judgement/noise.py",
        "RememberedNoise(names, sums, moments, biases, share)",
        "RememberedNoise(names, sums, moments, biases)",
        "sensors weigh the same, whatever noise they showed",
        ("test_judgement_noise.py",),
    ),
    Mutant(
        "judgement-fields-that-the-pose-takes-are-seen",
        "judgement/noise.py",
        "left = fields - J @ (drawn :=",
        "left = fields - 0 * J @ (drawn :=",
        "offsets that a pose takes for its own are thought to be small",
    ),
    Mutant(
        "judgement-outliers-in-the-covariance",
        "judgement/noise.py",
        "np.where(is_noise, found.shares, 0.0)",
        "found.shares",
        "a cut spot makes a frame unsure",
    ),
)

_EVIDENCE = (
    Mutant(
        "judgement-covered-features-missed-one-by-one",
        "judgement/judge.py",
        "most = 2 * detection.log_missed",
        "most = 20 * detection.log_missed",
        "of a rig of many cameras a body with a covered marker is lost",
    ),
    Mutant(
        "judgement-blind-cameras-miss-each-feature",
        "judgement/judge.py",
        "< detection.log_blind\n",
        "< -np.inf\n",
        "a body that one of several cameras does not see at all is never sure",
        ("test_judgement_evidence.py",),
    ),
    Mutant(
        "judgement-misses-are-free",
        "judgement/judge.py",
        "return math.log(1 - self.probability)",
        "return 0.0",
        "a pose that misses half of the body is as good as one that meets it",
    ),
    Mutant(
        "judgement-out-of-view-is-free",
        "judgement/judge.py",
        "unseen = found.unseen.sum(axis=-1) * detection.log_unseen",
        "unseen = 0.0",
        "a pose gains by moving features out of the picture",
    ),
    Mutant(
        "judgement-clutter-of-any-density",
        "judgement/judge.py",
        "np.maximum(crowd * (2",
        "np.maximum(1e-6 * (2",
        "poses in clutter are as sure as poses without",
    ),
    Mutant(
        "judgement-choices-cost-nothing",
        "judgement/judge.py",
        "+ missed - chosen - assigned +",
        "+ missed +",
        "among many detections some pose is sure to be found by chance",
    ),
    Mutant(
        "judgement-offsets-cost-nothing",
        "judgement/judge.py",
        "rarity[..., None] - _costs(found, roots, spreads)",
        "rarity[..., None]",
        "a pose that meets features loosely is as good as one that meets them",
    ),
    Mutant(
        "judgement-volume-of-the-other-sign",
        "judgement/judge.py",
        "laplace = -0.5 * np",
        "laplace = 0.5 * np",
        "poses that are known well count as known badly",
    ),
    Mutant(
        "judgement-prediction-does-not-count",
        "judgement/judge.py",
        " + laplace + log_densities",
        " + laplace",
        "a pose far from its prediction is as good as one near it",
    ),
    Mutant(
        "judgement-features-that-fix-the-pose-count",
        "judgement/judge.py",
        "gained * spare + missed",
        "gained + missed",
        "three features in one camera, which fit whatever they are, are evidence",
    ),
    Mutant(
        "judgement-a-point-in-space-counts-for-each-camera",
        "judgement/judge.py",
        "are_several = near.sum(axis=-2) > 1",
        "are_several = near.sum(axis=-2) > 9",
        "screws that all cameras see pass for the body",
    ),
    Mutant(
        "judgement-points-in-space-anywhere-are-the-feature",
        "judgement/judge.py",
        "0.5 * (rarity + tight - np.expm1(both - tight))",
        "0.5 * (rarity + tight)",
        "a false point beside a feature is as good as one at it",
    ),
    Mutant(
        "judgement-points-in-space-are-missed-again",
        "judgement/judge.py",
        "np.where(likelier, space, gained), np.where(likelier, 0.0, missed)",
        "np.where(likelier, space, gained), missed",
        "a covered camera makes what two others see doubtful",
    ),
)

_ACCEPTANCE = (
    Mutant(
        "judgement-rivals-never-count",
        "judgement/acceptance.py",
        "    rival: float = constant(0.01,",
        "    rival: float = constant(2.0,",
        "of two poses that fit alike one is called sure",
    ),
    Mutant(
        "judgement-rivals-count-when-it-is-too-late",
        "judgement/acceptance.py",
        "    rival: float = constant(0.01,",
        "    rival: float = constant(0.3,",
        "a frame with a rival of one in ten is called sure",
    ),
    Mutant(
        "judgement-sure-by-chance",
        "judgement/acceptance.py",
        "    sure: float = constant(7.0,",
        "    sure: float = constant(1.0,",
        "one pose in four of mere clutter is called sure",
    ),
    Mutant(
        "judgement-open-turns-are-sure",
        "judgement/acceptance.py",
        "bool(best.covariance[3:, 3:].trace() < math.pi**2 / 3)",
        "True",
        "the turn about a line of features is called sure",
    ),
    Mutant(
        "judgement-wide-turns-are-sure",
        "judgement/acceptance.py",
        "turn < math.radians(rules.widest_turn_deg)",
        "turn < np.inf",
        "ranges that leave the turn open are called sure",
        ("test_tracking_ranges.py",),
    ),
    Mutant(
        "judgement-doubtful-without-coverage",
        "judgement/acceptance.py",
        "first.coverage >= rules.doubtful_coverage",
        "first.coverage >= 0.0",
        "poses that meet two features in clutter are told",
    ),
    Mutant(
        "judgement-stands-out-by-one-feature",
        "judgement/acceptance.py",
        "np.count_nonzero(free) + rules.spare",
        "np.count_nonzero(free) + 2",
        "of one feature more than fixes a pose chance makes enough",
    ),
    Mutant(
        "judgement-one-of-many-stands-out",
        "judgement/acceptance.py",
        "rest + rules.standing_out",
        "-np.inf",
        "clutter without the body is never called lost",
    ),
    Mutant(
        "judgement-three-markers-of-eight-are-the-body",
        "judgement/acceptance.py",
        "and met >= min(rules.agreeing * in_view, rules.enough)",
        "",
        "three markers of another body pass for this one where it was expected",
    ),
    Mutant(
        "judgement-too-few-coordinates-fix-a-pose",
        "judgement/acceptance.py",
        "return bool(pose.measurements >= np.count_nonzero(free))",
        "return True",
        "a pose is told that the data do not fix",
    ),
    Mutant(
        "judgement-symmetric-poses-are-rivals",
        "judgement/acceptance.py",
        "T_b = nearest_alike(b.T_world_object, body, T_a)",
        "T_b = b.T_world_object",
        "a symmetric body is its own rival",
    ),
    Mutant(
        "judgement-anything-convinces",
        "judgement/acceptance.py",
        "is_sure(pose, free, rules) and share > rules.convincing",
        "is_sure(pose, free, rules)",
        "a body that slipped by a step of its grid is not looked for elsewhere",
    ),
    Mutant(
        "judgement-a-covered-sensor-makes-doubt",
        "judgement/acceptance.py",
        "if len(agreeing) > 1 else pose.coverage",
        "if len(agreeing) > 99 else pose.coverage",
        "a covered camera makes every frame slow",
    ),
    Mutant(
        "judgement-worse-twin-kept",
        "judgement/acceptance.py",
        "if new.log_evidence > old.log_evidence + more - 0.01:",
        "if new.log_evidence < old.log_evidence:",
        "of two fits that are one pose the worse is told",
    ),
)

_JUDGE = (
    Mutant(
        "judgement-left-out-for-free",
        "judgement/judge.py",
        "seen = replace(seen, shares=seen.shares * used[:, None])",
        "seen = replace(seen, weights=seen.weights * used[:, None])",
        "leaving a sensor out makes a pose better",
        ("test_tracking_starts.py",),
    ),
    Mutant(
        "judgement-symmetry-ignored",
        "judgement/acceptance.py",
        "if len(body.symmetries) == 1:",
        "if len(body.symmetries) >= 1:",
        "a symmetric body jumps between poses that look the same",
    ),
    Mutant(
        "judgement-any-noise-as-likely",
        "judgement/acceptance.py",
        "more = rules.sure *",
        "more = 0.0 *",
        "a bent pose is likelier than one that leaves out the spots that are off",
    ),
    Mutant(
        "judgement-most-turned-twin",
        "judgement/acceptance.py",
        "sum(axis=(1, 2)).argmax())",
        "sum(axis=(1, 2)).argmin())",
        "of poses that look the same the farthest is told",
    ),
    Mutant(
        "judgement-all-poses-believed-alike",
        "judgement/acceptance.py",
        "math.exp(one.log_evidence - top) if",
        "1.0 if",
        "evidence does not tell poses apart",
    ),
)

MUTANTS = (*_NOISE, *_FIELDS, *_EVIDENCE, *_ACCEPTANCE, *_JUDGE)

"""Mutants of `judgement`."""

from __future__ import annotations

from mutation.mutant import Mutant

_NOISE = (
    Mutant(
        "judgement-few-residuals-are-as-good-as-many",
        "judgement/noise.py",
        "return np.asarray(known / (known - 2))",
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
        "ratio = residual_ratio(own, known, model.by_chance, rules)",
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
        "judgement-pairs-of-markers-forgotten",
        "judgement/noise.py",
        "max(float(pairs - np.vdot(both, both)), 0.0)",
        "0.0",
        "markers that are off seem to be seen more surely than they are",
    ),
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
        "sums, moments, biases, share)",
        "sums, moments, biases)",
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
        "np.where(is_off, 0.0, found.shares * scale[:, None] / wide)",
        "found.shares * scale[:, None] / wide",
        "a cut spot makes a frame unsure",
    ),
)

_CUT = (
    Mutant(
        "judgement-nothing-is-cut",
        "judgement/cut.py",
        "np.where(v > 1, np.array([*errors.chances, 0.0])[:, None], 0.0)",
        "np.zeros(v.shape)",
        "a pose of few spots is as sure as if none of them could be cut",
        ("test_judgement_cut.py",),
    ),
    Mutant(
        "judgement-cut-not-beyond-the-ellipsoid",
        "judgement/cut.py",
        "(beyond > outside)[:-1].sum()",
        "(beyond > 1)[:-1].sum()",
        "of few spots one in a hundred poses is out of its ellipsoid",
        ("test_judgement_cut.py",),
    ),
    Mutant(
        "judgement-a-few-cut-spots-are-a-change-of-noise",
        "judgement/noise.py",
        "if sum(matches.met.tolist()) < model.fewest and",
        "if sum(matches.met.tolist()) < 0 and",
        "a pose that cut spots pull is as likely as its own residuals make it",
        ("test_judgement_noise.py",),
    ),
    Mutant(
        "judgement-open-poses-are-ok",
        "judgement/acceptance.py",
        "return ratio > rules.open and by_usual > 2 * len(C)",
        "return ratio > rules.open and by_usual > 1e9",
        "a direction that slivers alone tell is ok",
        ("test_judgement_cut.py",),
    ),
    Mutant(
        "judgement-open-however-precise",
        "judgement/acceptance.py",
        "return ratio > rules.open and by_usual > 2 * len(C)",
        "return ratio > rules.open",
        "precise poses of half of the features are doubted",
        ("test_judgement_cut.py",),
    ),
)

_MISTAKES = (
    Mutant(
        "judgement-bodies-have-the-size-that-is-told",
        "judgement/mistakes.py",
        "columns[1, :, 0] = model.turned *",
        "columns[1, :, 0] = 1e-9 *",
        "the tip of a tool that is a fiftieth too large is ok millimetres off",
        ("test_judgement_mistakes.py",),
    ),
    Mutant(
        "judgement-bodies-that-give-way-are-of-another-size",
        "judgement/mistakes.py",
        "axes *= np.sqrt(np.maximum(values, 0.0))[:, None]",
        "axes *= 0",
        "a body whose spread is stated is said to be of another size",
        ("test_judgement_mistakes.py",),
    ),
    Mutant(
        "judgement-mistakes-cost-nothing",
        "judgement/mistakes.py",
        "np.log(wide / s2).sum(axis=1)",
        "0 * np.log(wide / s2).sum(axis=1)",
        "what may explain anything is likelier than what is told",
        ("test_judgement_mistakes.py",),
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
        "np.maximum(rarity - _costs(found, roots, spreads), 0.0)",
        "np.maximum(rarity, 0.0)",
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
        "for odds in (0.0, *rivals)]",
        "for odds in (0.0,)]",
        "of two poses that fit alike one is called sure",
    ),
    Mutant(
        "judgement-clutter-never-counts",
        "judgement/acceptance.py",
        "for odds in (0.0, *rivals)]",
        "for odds in rivals]",
        "a pose that mere clutter explains as well is ok",
    ),
    Mutant(
        "judgement-sure-by-chance",
        "judgement/acceptance.py",
        "    confidence: float = constant(0.999,",
        "    confidence: float = constant(0.99,",
        "one pose in a hundred is called ok and wrong",
    ),
    Mutant(
        "judgement-the-likeliest-alternative-alone",
        "judgement/acceptance.py",
        "float(np.logaddexp.reduce([one.log_odds for one in self.against]))",
        "float(max([one.log_odds for one in self.against]))",
        "many poses of which each is unlikely leave a frame ok",
    ),
    Mutant(
        "judgement-open-turns-are-sure",
        "judgement/acceptance.py",
        "    if not is_turn_known(best, rules):",
        "    if False:",
        "the turn about a line of features is called sure",
    ),
    Mutant(
        "judgement-wide-turns-are-sure",
        "judgement/acceptance.py",
        "variances = pose.spread[3:] ** 2",
        "pass",
        "ranges that leave the turn open are called sure",
        ("test_tracking_ranges.py",),
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
        "T_new = nearest_alike(new.T_world_object, body, old.T_world_object)",
        "T_new = new.T_world_object",
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
        "is_better = new.log_evidence > old.log_evidence + more - 0.01",
        "is_better = new.log_evidence < old.log_evidence",
        "of two fits that are one pose the worse is told",
    ),
    Mutant(
        "judgement-twins-are-not-covered",
        "judgement/acceptance.py",
        "told.covariance + wider",
        "told.covariance",
        "of two poses about as likely one is told as if there were no other",
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
        "more = rules.log_doubt *",
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

MUTANTS = (*_NOISE, *_FIELDS, *_CUT, *_MISTAKES, *_EVIDENCE, *_ACCEPTANCE, *_JUDGE)

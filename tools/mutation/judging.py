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
        "return ratio / float(fdtri(degrees, known, model.by_chance))",
        "return 0.0",
        "a frame of large residuals is as sure as those before it",
    ),
    Mutant(
        "judgement-noise-with-the-coordinates-used-up",
        "judgement/noise.py",
        "_level(associations, int(free.sum()), known, model)",
        "_level(associations, 0, known, model)",
        "noise seems smaller than it is",
    ),
    Mutant(
        "judgement-information-in-sigmas",
        "judgement/stacked.py",
        "= one.J / one.sigma",
        "= one.J",
        "covariances depend on the unit of a sensor",
    ),
    Mutant(
        "judgement-unknown-noise-is-sigma",
        "judgement/noise.py",
        "typical = 0.0 if degrees >= 1 else model.errors.typical_degrees",
        "typical = 0.0",
        "three features in one camera have an exact pose",
    ),
)

_FIELDS = (
    Mutant(
        "judgement-fields-of-a-sensor-are-noise",
        "judgement/noise.py",
        "np.tensordot(shares.variances * factors, frame.parts, 1)",
        "shares.variances[0] * factors[0] * frame.parts[0]",
        "a camera that was turned after its calibration leaves the pose as sure as before",
    ),
    Mutant(
        "judgement-what-lasts-is-forgotten",
        "judgement/lasting.py",
        "if one.names == self.names and len(one.vector) == len(self.vector):",
        "if one.names != self.names:",
        "what is off by the same in every frame never shows",
    ),
    Mutant(
        "judgement-calibrations-are-exact",
        "judgement/noise.py",
        "inner += frame.by_calibration @ frame.by_calibration.T",
        "inner += 0",
        "a stated error of the focal length leaves the distance as sure as before",
    ),
    Mutant(
        "judgement-markers-off-are-noise",
        "judgement/moments.py",
        "seen[:, 3] = markers.squares",
        "seen[:, 3] = 0.0",
        "sensors that see a marker off in the same way count as independent",
    ),
    Mutant(
        "judgement-fields-that-the-pose-takes-are-seen",
        "judgement/moments.py",
        "left = fields - J @ drawn",
        "left = fields",
        "offsets that a pose takes for its own are thought to be small",
    ),
    Mutant(
        "judgement-outliers-in-the-covariance",
        "judgement/moments.py",
        "shares = np.where(clear, found.shares, 0.0)",
        "shares = found.shares",
        "a cut spot makes a frame unsure",
    ),
)

_EVIDENCE = (
    Mutant(
        "judgement-covered-features-missed-one-by-one",
        "judgement/evidence.py",
        "return 2 * self.log_missed",
        "return 20 * self.log_missed",
        "of a rig of many cameras a body with a covered marker is lost",
    ),
    Mutant(
        "judgement-misses-are-free",
        "judgement/evidence.py",
        "return math.log(1 - self.probability)",
        "return 0.0",
        "a pose that misses half of the body is as good as one that meets it",
    ),
    Mutant(
        "judgement-out-of-view-is-free",
        "judgement/evidence.py",
        'found.gathered("unseen").sum(axis=1) * detection.log_unseen',
        "0.0",
        "a pose gains by moving features out of the picture",
    ),
    Mutant(
        "judgement-clutter-of-any-density",
        "judgement/evidence.py",
        "density = one.crowd *",
        "density = 1e-6 *",
        "poses in clutter are as sure as poses without",
    ),
    Mutant(
        "judgement-choices-cost-nothing",
        "judgement/evidence.py",
        "return np.asarray(ways + assigned + math.log(2))",
        "return np.asarray(0 * ways + math.log(2))",
        "among many detections some pose is sure to be found by chance",
    ),
    Mutant(
        "judgement-offsets-cost-nothing",
        "judgement/evidence.py",
        "rarity[:, None] - _costs(one, variance, spreads)",
        "rarity[:, None]",
        "a pose that meets features loosely is as good as one that meets them",
    ),
    Mutant(
        "judgement-volume-of-the-other-sign",
        "judgement/evidence.py",
        "math.log(2 * math.pi) - _log_det(inner))",
        "math.log(2 * math.pi) + _log_det(inner))",
        "poses that are known well count as known badly",
    ),
    Mutant(
        "judgement-prediction-does-not-count",
        "judgement/evidence.py",
        " + laplace + log_densities",
        " + laplace",
        "a pose far from its prediction is as good as one near it",
    ),
    Mutant(
        "judgement-features-that-fix-the-pose-count",
        "judgement/evidence.py",
        "odds.gained * np.maximum(spare, 0.0) + odds.missed",
        "odds.gained + odds.missed",
        "three features in one camera, which fit whatever they are, are evidence",
    ),
    Mutant(
        "judgement-a-point-in-space-counts-for-each-camera",
        "judgement/evidence.py",
        "together = np.nonzero(np.sum(near, axis=0) > 1)",
        "together = np.nonzero(np.sum(near, axis=0) > 9)",
        "screws that all cameras see pass for the body",
    ),
    Mutant(
        "judgement-points-in-space-anywhere-are-the-feature",
        "judgement/evidence.py",
        "log_rarity + tight - 0.5 * away",
        "log_rarity + tight",
        "a false point beside a feature is as good as one at it",
    ),
    Mutant(
        "judgement-points-in-space-are-missed-again",
        "judgement/evidence.py",
        "gained[pose, feature], missed[pose, feature] = space[likelier], 0.0",
        "gained[pose, feature] = space[likelier]",
        "a covered camera makes what two others see doubtful",
    ),
)

_ACCEPTANCE = (
    Mutant(
        "judgement-rivals-never-count",
        "judgement/acceptance.py",
        "rival: float = constant(0.01,",
        "rival: float = constant(2.0,",
        "of two poses that fit alike one is called sure",
    ),
    Mutant(
        "judgement-rivals-count-when-it-is-too-late",
        "judgement/acceptance.py",
        "rival: float = constant(0.01,",
        "rival: float = constant(0.3,",
        "a frame with a rival of one in ten is called sure",
    ),
    Mutant(
        "judgement-sure-by-chance",
        "judgement/acceptance.py",
        "sure: float = constant(\n        7.0,",
        "sure: float = constant(\n        1.0,",
        "one pose in four of mere clutter is called sure",
    ),
    Mutant(
        "judgement-open-turns-are-sure",
        "judgement/acceptance.py",
        "return bool(turns.max() < _OPEN_TURN**2)",
        "return True",
        "the turn about a line of features is called sure",
    ),
    Mutant(
        "judgement-wide-turns-are-sure",
        "judgement/acceptance.py",
        "return bool(1.96 * judged.spread[3:].max() < np.radians(rules.widest_turn_deg))",
        "return True",
        "ranges that leave the turn open are called sure",
        ("test_tracking_ranges.py",),
    ),
    Mutant(
        "judgement-doubtful-without-coverage",
        "judgement/acceptance.py",
        "ranked[0].coverage < rules.doubtful_coverage",
        "ranked[0].coverage < 0.0",
        "poses that meet two features in clutter are told",
    ),
    Mutant(
        "judgement-stands-out-by-one-feature",
        "judgement/acceptance.py",
        "int(free.sum()) + rules.spare",
        "int(free.sum()) + 2",
        "of one feature more than fixes a pose chance makes enough",
    ),
    Mutant(
        "judgement-one-of-many-stands-out",
        "judgement/acceptance.py",
        "float(rest) + rules.standing_out",
        "-np.inf",
        "clutter without the body is never called lost",
    ),
    Mutant(
        "judgement-three-markers-of-eight-are-the-body",
        "judgement/acceptance.py",
        "return len(met) >= min(rules.majority * len(in_view), rules.enough)",
        "return True",
        "three markers of another body pass for this one where it was expected",
    ),
    Mutant(
        "judgement-too-few-coordinates-fix-a-pose",
        "judgement/acceptance.py",
        "return judged.measurements >= int(free.sum())",
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
        "return share > rules.convincing and is_sure(judged, free, rules)",
        "return is_sure(judged, free, rules)",
        "a body that slipped by a step of its grid is not looked for elsewhere",
    ),
    Mutant(
        "judgement-a-covered-sensor-makes-doubt",
        "judgement/acceptance.py",
        "if len(agreeing) > 1 else judged.coverage",
        "if len(agreeing) > 99 else judged.coverage",
        "a covered camera makes every frame slow",
    ),
    Mutant(
        "judgement-worse-twin-kept",
        "judgement/acceptance.py",
        "if new.log_evidence > old.log_evidence - rules.as_evident:",
        "if new.log_evidence < old.log_evidence:",
        "of two fits that are one pose the worse is told",
    ),
)

_JUDGE = (
    Mutant(
        "judgement-symmetry-ignored",
        "judgement/judge.py",
        "if len(body.symmetries) == 1:",
        "if len(body.symmetries) >= 1:",
        "a symmetric body jumps between poses that look the same",
    ),
    Mutant(
        "judgement-any-noise-as-likely",
        "judgement/acceptance.py",
        "more = rules.unlike *",
        "more = 0.0 *",
        "a bent pose is likelier than one that leaves out the spots that are off",
    ),
    Mutant(
        "judgement-most-turned-twin",
        "judgement/judge.py",
        "alike[int(np.argmax(traces))]",
        "alike[int(np.argmin(traces))]",
        "of poses that look the same the farthest is told",
    ),
    Mutant(
        "judgement-all-poses-believed-alike",
        "judgement/judge.py",
        "weights = np.exp(logs - logs.max())",
        "weights = np.ones(len(logs))",
        "evidence does not tell poses apart",
    ),
    Mutant(
        "judgement-merged-features-move-as-one",
        "judgement/association.py",
        "np.where(paired[:, None, None], (J + J[met.partner]) / 2, J)",
        "np.where(paired[:, None, None], J, J)",
        "the middle of two features moves as if it were one of them",
        ("test_tracking_outliers.py",),
    ),
    Mutant(
        "judgement-out-of-view-is-covered",
        "judgement/association.py",
        "max(self.expected + self.unseen, 1e-12)",
        "max(self.expected, 1e-12)",
        "a body half out of the picture convinces",
    ),
    Mutant(
        "judgement-ranges-have-two-coordinates",
        "judgement/association.py",
        "return self.met * int(self.J.shape[1])",
        "return self.met * 2",
        "ranges seem to fix poses that they leave open",
    ),
)

MUTANTS = (*_NOISE, *_FIELDS, *_EVIDENCE, *_ACCEPTANCE, *_JUDGE)

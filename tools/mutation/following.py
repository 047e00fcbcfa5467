"""Mutants of `tracking`, but for its proposers."""

from __future__ import annotations

from mutation.mutant import Mutant

_STARTS = "test_tracking_starts.py"
_TWIN = "test_tracking_twin.py"
_DELAYS = "test_tracking_delays.py"
_WINDOWS = "test_tracking_gating.py"
_TRACK = "test_tracking_track.py"

_PREDICTION = (
    Mutant(
        "tracking-velocities-per-second-taken-per-frame",
        "tracking/track.py",
        "return (time_s is None) == (self.time_s is None)",
        "return True",
        "after a frame without a time the body is looked for far away",
        ("test_tracking_track.py",),
    ),
    Mutant(
        "tracking-clocks-may-go-back",
        "tracking/track.py",
        "max(time_s - self.time_s, 0.0)",
        "time_s - self.time_s",
        "a live clock that is set back ends in a traceback",
        ("test_tracking_track.py",),
    ),
    Mutant(
        "tracking-errors-over-a-gap-count-for-one-frame",
        "tracking/following.py",
        "np.abs(change / (1 + track.misses))",
        "np.abs(change / 1)",
        "after a gap a body may be anywhere in the next frame",
    ),
    Mutant(
        "tracking-predictions-without-tails",
        "tracking/track.py",
        "if self.spread is None:",
        "if False:",
        "a body that turns suddenly is lost",
    ),
    Mutant(
        "tracking-prior-as-wide-as-the-world",
        "tracking/frame.py",
        "return float(reduce(np.logaddexp, terms)), spreads[terms.index(max(terms))]",
        "return float(reduce(np.logaddexp, terms)), anywhere[1]",
        "a pose near its prediction that meets one feature has high evidence",
        (_TRACK,),
    ),
    Mutant(
        "tracking-velocity-not-used",
        "tracking/track.py",
        "T = perturb(T, branch.velocity * elapsed)",
        "T = perturb(T, 0 * branch.velocity)",
        "a fast body is looked for where it was",
        (_TRACK,),
    ),
    Mutant(
        "tracking-coasts-for-ever",
        "tracking/track.py",
        "elif branch.velocity is not None and track.misses <= rules.coasting and is_timed:",
        "elif branch.velocity is not None:",
        "after an occlusion the body is looked for far beyond where it can be",
        (_TRACK,),
    ),
    Mutant(
        "tracking-prediction-never-widens",
        "tracking/track.py",
        "branch.T_world_object, branch.uncertainty * widening",
        "branch.T_world_object, branch.uncertainty",
        "after an occlusion the body is expected as surely as before it",
        (_TRACK,),
    ),
    Mutant(
        "tracking-never-surprised",
        "tracking/motion.py",
        "min(self.surprise * (1 + misses), 1.0)",
        "1e-300",
        "a body that was carried elsewhere is never believed there",
        (_TRACK,),
    ),
    Mutant(
        "tracking-as-surprised-after-misses",
        "tracking/motion.py",
        "min(self.surprise * (1 + misses), 1.0)",
        "min(self.surprise, 1.0)",
        "after an occlusion the body is believed where it was",
        (_TRACK,),
    ),
    Mutant(
        "tracking-prediction-of-one-symmetric-pose",
        "tracking/frame.py",
        "T = nearest_alike(T_world_object, self.body, branch.T_world_object)",
        "T = T_world_object",
        "a pose that looks as predicted counts as unexpected",
        (_TRACK,),
    ),
    Mutant(
        "tracking-misses-not-counted",
        "tracking/track.py",
        "misses=self.misses + 1",
        "misses=self.misses",
        "nothing widens while a body is not seen",
        (_TRACK,),
    ),
    Mutant(
        "tracking-velocity-per-pair-of-frames",
        "tracking/following.py",
        "velocity = moved / elapsed\n            last",
        "velocity = moved\n            last",
        "velocities depend on the rate of frames",
        (_TRACK,),
    ),
    Mutant(
        "tracking-a-velocity-knows-nothing-of-the-pose",
        "tracking/in_motion.py",
        "-np.diag(expected.gain[free])",
        "0 * np.diag(expected.gain[free])",
        "late sensors are seen at the velocity of another pose",
        (_DELAYS,),
    ),
    Mutant(
        "tracking-one-of-late-cameras-chosen",
        "tracking/in_motion.py",
        "wide = max(by_velocity, 1.0)",
        "pass",
        "a fast body before a late camera is where one of the cameras alone sees it",
        (_TWIN,),
    ),
    Mutant(
        "tracking-fast-bodies-expected-at-rest",
        "tracking/frame.py",
        "return branch.motion_filter.expected(moved if seen else None, elapsed)",
        "expected = branch.motion_filter.expected(moved if seen else None, elapsed)\n"
        "        return resting if (np.abs(expected.velocity) > resting.deviation).any() "
        "else expected",
        "late cameras contradict each other where a body moves faster than most",
        (_TWIN,),
    ),
    Mutant(
        "tracking-a-turn-left-open-is-known",
        "tracking/tracker.py",
        "left_open=verdict.open_share * momentary,",
        "left_open=0 * momentary,",
        "a turn that a frame left open is believed in the next one",
        (_TRACK,),
    ),
    Mutant(
        "tracking-what-is-open-moves-the-prediction",
        "tracking/following.py",
        "axes @ (gains * (off @ axes))",
        "off",
        "a turn that a frame left open is that which it happened to have",
        (_TRACK,),
    ),
    Mutant(
        "tracking-sudden-motion-goes-unnoticed",
        "tracking/following.py",
        "np.maximum(change.max(axis=1).repeat(3), steady)",
        "steady",
        "a body that changes its speed is expected as surely as a steady one",
        (_TRACK,),
    ),
    Mutant(
        "tracking-goes-on-from-the-farthest-branch",
        "tracking/track.py",
        "np.linalg.norm(twists, axis=1).argmin()",
        "np.linalg.norm(twists, axis=1).argmax()",
        "of two poses each takes the velocity of the other",
        (_TRACK,),
    ),
)

_MOTION = (
    Mutant(
        "tracking-walk-whatever-the-time",
        "tracking/motion.py",
        "self.rules.persistence * self.rates / self.count * elapsed)",
        "self.rules.persistence * self.rates / self.count)",
        "a body is expected as near after a second as after a frame",
        (_TRACK,),
    ),
    Mutant(
        "tracking-walk-of-one-kind",
        "tracking/motion.py",
        "rate = np.maximum(shares, self.rules.other_kind * other) / lever**2 / elapsed",
        "rate = shares / lever**2 / elapsed",
        "a body that only shifted so far is not expected to turn",
        (_TRACK,),
    ),
    Mutant(
        "tracking-delays-of-the-other-sign",
        "tracking/frame.py",
        "replace(view, sensor=in_motion(view.sensor, motion, view.delay, view.readout))",
        "replace(view, sensor=in_motion(view.sensor, motion, -view.delay, view.readout))",
        "sensors are put twice as far out of step",
        (_DELAYS,),
    ),
    Mutant(
        "tracking-clocks-with-nothing-in-common-believed",
        "tracking/track.py",
        "all(abs(view.delay) <= 10 * self.unknown_s for view in applied)",
        "all(abs(view.delay) <= 1e99 for view in applied)",
        "sensors of clocks that began at different times are moved away",
        (_DELAYS,),
    ),
)

_GATING = (
    Mutant(
        "tracking-windows-for-ever",
        "tracking/scene.py",
        "in_turn = any(track.is_in_turn(frame, self.scene.rules.thorough) for track in tracks)",
        "in_turn = False",
        "what enters the view elsewhere is never seen",
        ("test_runner_windows.py",),
    ),
    Mutant(
        "tracking-windows-are-sure",
        "tracking/scene.py",
        "            if self._are_sure(after) and all(",
        "            if after or all(",
        "a body that left its window is lost, or in doubt for nothing",
        ("test_runner_windows.py",),
    ),
    Mutant(
        "tracking-windows-of-an-exact-prediction",
        "tracking/scene.py",
        "margins = self.reach * np.sqrt(by_pose)",
        "margins = 0 * np.sqrt(by_pose)",
        "a body that moves otherwise than predicted is cut off",
        (_WINDOWS,),
    ),
    Mutant(
        "tracking-windows-without-a-rim",
        "tracking/scene.py",
        "min_margin_px: float = constant(40.0,",
        "min_margin_px: float = constant(0.0,",
        "features at the rim are cut off",
        (_WINDOWS,),
    ),
    Mutant(
        "tracking-windows-of-points",
        "tracking/scene.py",
        "np.maximum(scales * self._feature_reach, self.min_margin_px)",
        "np.maximum(0 * scales, self.min_margin_px)",
        "features that are large in the image are cut off",
        (_WINDOWS,),
    ),
    Mutant(
        "tracking-windows-of-the-last-branch",
        "tracking/scene.py",
        "np.where(seen, images.y - margins, np.inf).min(axis=(1, 2))",
        "np.where(seen, images.y - margins, np.inf)[:, -1].min(axis=1)",
        "of two possible poses one is not looked at",
        (_WINDOWS,),
    ),
    Mutant(
        "tracking-windows-begin-at-hidden-features",
        "tracking/scene.py",
        "lower = np.where(seen, images.y - margins, np.inf)",
        "lower = np.where(True, images.y - margins, np.inf)",
        "windows reach to features that no camera sees",
        (_WINDOWS,),
    ),
)

_TRACKER = (
    Mutant(
        "tracking-noise-of-doubtful-frames-kept",
        "tracking/tracker.py",
        "residuals=best.noise if is_ok else track.residuals,",
        "residuals=best.noise,",
        "residuals of a wrong pose make the frames after it unsure",
        (_TRACK,),
    ),
    Mutant(
        "tracking-sensors-left-out-are-tallied",
        "tracking/tracker.py",
        "used = best.used\n",
        "used = best.matches\n",
        "the next frame is looked at as a whole although all is well",
        (_STARTS,),
    ),
    Mutant(
        "tracking-start-widths-ignored",
        "tracking/tracker.py",
        "start[:3] = distance",
        "start[:3] *= 1.0",
        "how far off a start may be does nothing",
        (_TRACK,),
    ),
    Mutant(
        "tracking-sure-frames-have-rivals",
        "tracking/tracker.py",
        'rivals = verdict.kept if verdict.status == "ambiguous" else ()',
        "rivals = verdict.kept",
        "frames that are sure list hypotheses",
        (_TRACK,),
    ),
)

_STATIC = (
    Mutant(
        "tracking-static-clutter-is-searched-first",
        "tracking/static_clutter.py",
        "[view.only(mask) for view, mask in",
        "[view for view, _ in",
        "a room full of lamps hides what comes into it",
        ("test_tracking_static.py",),
    ),
    Mutant(
        "tracking-static-clutter-for-ever",
        "tracking/static_clutter.py",
        "np.where(is_met, 1, -1)",
        "np.where(is_met, 1, 0)",
        "a lamp that was moved is left out for ever",
        ("test_tracking_static.py",),
    ),
    Mutant(
        "tracking-what-stands-still-is-never-found",
        "tracking/proposers.py",
        "return among_moving + candidates",
        "return among_moving or candidates[:0]",
        "a body that stands still is not looked for",
        ("test_tracking_static.py",),
    ),
)

_NOISE = (
    Mutant(
        "tracking-no-noise-is-a-sensor-s-own",
        "tracking/likelihood.py",
        "fields=seen.track.residuals.fields",
        "fields=1.0",
        "sensors weigh the same, whatever noise they showed",
        ("test_tracking.py",),
    ),
    Mutant(
        "tracking-merged-spots-pull-by-all-that-they-are-off",
        "tracking/refinements.py",
        "matches.shares * weights",
        "matches.shares",
        "a spot of two features that is cut bends the pose",
        ("test_tracking_refinements.py",),
    ),
)

_SHARING = (
    Mutant(
        "tracking-merged-spots-stay-with-one-body",
        "tracking/claims.py",
        "owners[loose[is_near]] = -2",
        "owners[loose[is_near]] = k",
        "a spot that is two bodies' pulls at one of them",
        ("test_several_bodies_scene.py",),
    ),
    Mutant(
        "tracking-merged-spots-are-left-out-of-evidence-alone",
        "tracking/sharing.py",
        "are_fitted = -2 in claims.owners",
        "are_fitted = False",
        "a pose stays where a spot of two bodies has pulled it",
        ("test_several_bodies_scene.py",),
    ),
    Mutant(
        "tracking-merged-spots-met-closely",
        "tracking/claims.py",
        "(squared > rules.pulled) & (self",
        "(squared < rules.pulled) & (self",
        "spots that are met closely are taken from their body beside another",
        ("test_several_bodies_scene.py",),
    ),
)

MUTANTS = (
    *_PREDICTION,
    *_MOTION,
    *_GATING,
    *_TRACKER,
    *_STATIC,
    *_NOISE,
    *_SHARING,
)

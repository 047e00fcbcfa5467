"""Mutants of what tells poses of one body apart, of its middle, and of frames told apart."""

from __future__ import annotations

from mutation.mutant import Mutant

_RIVALS = "test_tracking_rivals.py"

MUTANTS = (
    Mutant(
        "tracking-frames-that-are-alike-add-up",
        "tracking/rivals.py",
        "if now * before > 0:",
        "if False:",
        "frames that tell nothing by themselves make one of two poses sure",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-a-row-too-many-is-chance",
        "tracking/rivals.py",
        "max(_of_more_than_told(data, rival, best), 0.0)",
        "0.0",
        "of a board with a row more than told the row that is met closer is ok",
        (_RIVALS,),
    ),
    Mutant(
        "body-steps-of-small-grids-are-no-rivals",
        "body/look_alikes.py",
        "if np.count_nonzero(near) > max(len(chosen) // 2, FEWEST):",
        "if np.count_nonzero(near) > len(chosen):",
        "a board of four rows is ok a row aside",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-sensors-are-not-asked-each-alone",
        "tracking/twin.py",
        "if (apart := _sure_by(data, others)) is not None:",
        "if (apart := None) is not None:",
        "of two cameras one shows an old frame, and is ok",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-symmetric-poses-go-on-from-others",
        "tracking/track.py",
        "twist_between(T, nearest_alike(T_world_object, body, T)) / scale",
        "twist_between(T, T_world_object) / scale",
        "a rival of a symmetric board is expected half a turn on",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-symmetric-rivals-turn-by-half-a-turn",
        "tracking/frame.py",
        "T = nearest_alike(T, body, parent.T_world_object)",
        "T = T.copy()",
        "a rival of a symmetric board turns by half a turn from frame to frame",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-origin-on-the-other-side",
        "tracking/tracker.py",
        "return replace(tracker, origin=-centre)",
        "return replace(tracker, origin=centre)",
        "poses are off by twice the distance from the origin to the middle",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-covariance-of-the-middle",
        "tracking/tracker.py",
        "if not self.origin.any():",
        "if True:",
        "a tip that is far from the markers seems to be known as well as they are",
        (_RIVALS,),
    ),
    Mutant(
        "tracking-held-directions-are-the-middles",
        "tracking/tracker.py",
        "if any((free[1] & (np.arange(3) != held)).any() for held in np.flatnonzero(~free[0])):",
        "if False:",
        "a body that turns about a pivot is held at its middle",
        (_RIVALS,),
    ),
    Mutant(
        "checking-times-of-other-moments-are-silent",
        "checking/recordings.py",
        "(off := float(np.median(apart))) > usual:",
        "(off := float(np.median(apart))) > 1e9:",
        "frames that are paired by number are of other moments, and nothing is said",
        ("test_check_pairing.py",),
    ),
    Mutant(
        "learning-frames-turned-over-count",
        "learning/adjusting.py",
        "return told if len(told) >= rules.least_frames else body.places",
        "return body.places",
        "a tool that turns about one axis seems to turn over",
        ("test_learn.py",),
    ),
)

"""Numbers for the diagnosis of a session."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class DiagnosisRules:
    """Rules when a change of the session explains its frames better and is reported."""

    frames: int = constant(4, "estimated: a wrong session shows in all, a hidden body in some")
    sure: float = constant(7.0, "log odds from which a frame is explained, or a pose is ok")
    met: float = constant(
        0.5, "of what a sensor could meet, at least: beside a hand 0.6, by wrong normals 0.4"
    )
    noise: float = constant(
        0.75, "RMS offset in sigma: right sessions of real recordings have up to 0.65, others 1"
    )
    margin: float = constant(
        12.0,
        "nats that a change gains at least: right sessions gain up to 5 after the cost of values, "
        "of 80 changes; a marker that is found again gains 9 in a frame",
    )
    undecided: float = constant(
        6.0, "nats from which a gain by values is too large for chance: more frames are tried"
    )
    chance: float = constant(5.0, "nats by which two searches of the same frame may differ")
    rival: float = constant(10.0, "nats within which another change is as good: twice `chance`")
    share: float = constant(0.05, "of the gain: as good, too, as errors of frames are alike")
    promise: float = constant(
        4.0,
        "nats that least squares predict, from which a change is tried: a marker 5 mm off has at "
        "least 7, right sessions of a hand at most 2",
    )
    most: int = constant(8, "changes by values that are tried, the most promising first")
    markers: int = constant(
        2, "of these for markers: with a body 2 % too large, 3 of 72 promise more than its size"
    )
    clearer: float = constant(
        0.65, "ratio of RMS offsets below which a gain is reported: right rigs reach 0.79"
    )
    more: float = constant(0.02, "of the features met: with as many more a gain is reported")
    fewer: float = constant(
        0.95,
        "share of the features met before that a change has to meet: wrong poses meet one in 50 by "
        "chance",
    )
    guesses: float = constant(
        10_000,
        "limit for a search in a frame by a changed session: for right sessions poses are found "
        "with fewer than 2,000 by two cameras, with 10,000 by one that sees 40 corners; wrong ones "
        "would take 250,000",
    )
    behind: float = constant(0.5, "share of the best gain so far, below which a change drops out")
    leaders: int = constant(
        3, "changes that gain most without explaining a frame, combined with every other change"
    )
    all_guesses: float = constant(
        800_000,
        "guesses for all changes without values: pairs take 700,000, 8 s; the same on any machine",
    )
    in_vain: float = constant(
        100_000,
        "guesses after which frames are no longer estimated by the session as it is: 1 s, for 400 "
        "dots 3 s",
    )

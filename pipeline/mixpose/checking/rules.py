"""Numbers by which it is told what is wrong with a session."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class DiagnosisRules:
    """When a change of the session is told."""

    frames: int = constant(4, "that are estimated: a fault shows in all, a hidden body in some")
    sure: float = constant(7.0, "log odds of a frame that is explained, as where a pose is ok")
    met: float = constant(
        0.5, "of what a sensor could meet, at least: beside a hand 0.6, by wrong normals 0.4"
    )
    noise: float = constant(
        0.75, "of sigma: right sessions of real recordings meet features to 0.65, others to 1"
    )
    margin: float = constant(
        12.0,
        "nats by which a change explains frames better: right sessions gain up to 5 after what "
        "values cost, of 80 changes; a marker that is found again gains 9 in a frame",
    )
    undecided: float = constant(
        6.0, "nats by which a change by values gains too little to be told, and too much for chance"
    )
    chance: float = constant(5.0, "nats by which two estimates of a frame may differ")
    rival: float = constant(10.0, "nats within which another change is as good: twice as much")
    share: float = constant(0.05, "of what is gained, as well: errors of frames are alike")
    promise: float = constant(
        4.0,
        "nats that least squares foretell, for a change to be tried: a marker 5 mm off has 7 at "
        "least, right sessions of a hand 2 at most",
    )
    most: int = constant(8, "changes of values that are tried, the most promising first")
    markers: int = constant(
        2, "of these for markers: a body 2 % too large has 3 of 72 promise more than its size does"
    )
    clearer: float = constant(
        0.65, "of the offsets left by a change that is told for that: right rigs gain down to 0.79"
    )
    more: float = constant(0.02, "of the features met by a change that is told for more of them")
    fewer: float = constant(
        0.95,
        "of the features met before, at least by a change that is told: wrong poses meet one in 50 "
        "by chance",
    )
    guesses: float = constant(
        10_000,
        "of a search in a frame by a changed session: poses of right sessions are found with fewer "
        "than 2,000 by two cameras, with 10,000 by one that sees 40 corners; wrong "
        "ones would take 250,000",
    )
    behind: float = constant(0.5, "of the best gain so far, below which a change is tried no more")
    leaders: int = constant(
        3, "changes that explain most, though no frame, that are tried with each other one as well"
    )
    all_guesses: float = constant(
        800_000,
        "of all changes without values: two at once take 700,000; 8 s, and the same on any machine",
    )
    in_vain: float = constant(
        100_000,
        "guesses, after which no more frames are estimated by the session as it is: 1 s, of 400 "
        "dots 3 s",
    )

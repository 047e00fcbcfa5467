"""What a calibration goes by, with reasons."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class CalibrationRules:
    """Limits, tolerances and blurs of a calibration."""

    blur: float = constant(
        2.0,
        "last blur by the noise that residuals show: a detection between two features 6 standard "
        "deviations apart is shared",
    )
    tail: float = constant(
        3.0,
        "scale of the Cauchy weights of the last steps, by the noise: 97 % as precise as least "
        "squares where errors are Gaussian",
    )
    narrowing: float = constant(0.5, "of a blur to the next: halving loses no frame of any case")
    first_blur: float = constant(2.0, "of the median distance to the nearest feature at the start")
    widest: float = constant(0.35, "of the distance between neighbouring features in a sensor")
    steps: int = constant(4, "Gauss-Newton steps at each blur but the last")
    last_steps: int = constant(40, "most at the last blur; most cases need 6")
    converged: float = constant(1e-3, "standard deviations moved in a step: then it is the last")
    alike: float = constant(
        20.0, "coordinates of a sensor by which its own noise weighs as much as that of its kind"
    )
    unlike: float = constant(
        1.4,
        "times the noise of its kind that a sensor's may be, or that may be its, where errors of "
        "detections are independent",
    )
    faintest: float = constant(0.02, "weight below which a pair of detection and feature is left")
    faintest_last: float = constant(
        1e-6, "the same in the last steps: 15 standard deviations, whose Cauchy weight is 0.04"
    )
    margin: float = constant(12.0, "log-odds behind the best pose of a sensor: less likely is none")
    hypotheses: int = constant(6, "poses kept for a sensor's frame: flat bodies have two or four")
    turn_deg: float = constant(
        6.0, "by which poses of single cameras err at most, flat bodies seen from afar included"
    )
    shift: float = constant(0.12, "of the distance to the body, likewise: depth errs most")
    seeds: int = constant(600, "relative poses that are tried as the middle of all others")
    least_link: int = constant(2, "frames that must agree on where two sensors stand")
    held_back: float = constant(
        0.2, "of the frames at a time, each once: their residual is that of unseen data"
    )
    least_frames: int = constant(4, "left to calibrate from, else none is held back")
    most_read: int = constant(720, "frames read: a longer recording is thinned out evenly")
    most_candidates: int = constant(
        240, "of them are searched: those that add most information; a camera's takes 0.1 to 1 s"
    )
    least_met: float = constant(0.3, "of a sensor's features in view; less and its frame is bad")
    undetermined: float = constant(
        0.25,
        "standard deviation by the size of what is sought (the rig, a focal length, a turn of "
        "1 rad): nothing is known of such a direction",
    )
    far: float = constant(
        3.0, "deviations that a lens is moved by, to see whether the fit gets worse"
    )
    flat: float = constant(
        0.5, "of what these mean for the fit, below which a deviation is wider: right ones have 1"
    )
    rescaled: float = constant(
        0.05, "log of the scale that a known length may give: bodies are known to a few per cent"
    )
    widened: tuple[float, ...] = constant(
        (1.0, 2.5, 6.0),
        "σ_ε with which sensors that know no pose alone are tried together, until the rig can be "
        "adjusted: sensors 30 mm off need the second where σ_ε is 5 mm",
    )
    probes: int = constant(
        10, "frames by which that blur is chosen where each is searched by itself: 0.7 s each"
    )
    failed: float = constant(
        1.9, "σ_ε that residuals err by where nothing was found: they may err by 2"
    )
    certain: float = constant(
        0.8,
        "of the weight of pairs is between nearest ones where features are told apart: right rigs "
        "of simulated range sensors have 0.98 and more, wrong ones 0.4, ranges that do not tell "
        "tags apart 0.5",
    )
    by_chance: float = constant(
        1e-6,
        "chance that a recording contradicts what is held as much, though it is right: up to a "
        "hundred things are asked",
    )
    rising: float = constant(
        1.5,
        "times the residual of the other frames that that of frames held back may be: six or more "
        "frames held back vary by 0.2",
    )
    believed: float = constant(0.3, "of the frames: with fewer, doubtful poses are a start too")
    explained: float = constant(
        0.5,
        "of a sensor's detections, which poses must explain: of fifteen cameras those that stand "
        "right have 0.68 and more, those 2 and 5 degrees off 0.15",
    )
    least_detections: int = constant(8, "explained likewise: four points fit many places")
    gap: float = constant(2.5, "frame intervals over which motion is interpolated")
    moved: float = constant(
        4.0, "standard deviations: a sensor that did not move is never that far off in simulation"
    )
    worse: float = constant(
        1.5, "times the residual of a new calibration, from which an old one no longer holds"
    )

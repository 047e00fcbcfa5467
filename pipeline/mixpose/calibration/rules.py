"""The limits and tolerances of a calibration, with reasons."""

from __future__ import annotations

from dataclasses import dataclass

from mixpose.constants import constant


@dataclass(frozen=True)
class CalibrationRules:
    """Limits, tolerances and blurs of a calibration."""

    blur: float = constant(
        2.0,
        "last blur in units of the noise of residuals: a detection between two features 6 standard "
        "deviations apart is shared",
    )
    tail: float = constant(
        3.0,
        "scale of the Cauchy weights of the last steps, in units of the noise: 97 % as precise as "
        "least squares if errors are Gaussian",
    )
    narrowing: float = constant(0.5, "of the blur before: halving loses no frame of any case")
    first_blur: float = constant(2.0, "of the median distance to the nearest detection at first")
    widest: float = constant(0.35, "of the distance between neighbouring features in a sensor")
    steps: int = constant(4, "Gauss-Newton steps at each blur but the last")
    last_steps: int = constant(40, "most at the last blur; most cases need 6")
    converged: float = constant(1e-3, "standard deviations: a smaller step is the last")
    alike: float = constant(
        20.0, "coordinates of a sensor whose own noise weighs as much as that of its kind"
    )
    unlike: float = constant(
        1.4,
        "largest ratio, either way, of a sensor's noise to that of its kind, if errors of "
        "detections are independent",
    )
    faintest: float = constant(0.02, "least weight of a pair of detection and feature")
    faintest_last: float = constant(
        1e-6, "the same in the last steps: 15 standard deviations, whose Cauchy weight is 0.04"
    )
    margin: float = constant(12.0, "log-odds below a sensor's best pose; poses below are dropped")
    hypotheses: int = constant(6, "poses kept for a sensor's frame: flat bodies have two or four")
    turn_deg: float = constant(
        6.0, "largest error of poses of single cameras, also of flat bodies seen from afar"
    )
    shift: float = constant(0.12, "of the distance to the body, likewise: depth is least accurate")
    seeds: int = constant(600, "relative poses that are tried as the centre of a cluster")
    least_link: int = constant(2, "frames that must agree on where two sensors stand")
    held_back: float = constant(
        0.2, "of the frames at a time, each once: their residual is that of unseen data"
    )
    least_frames: int = constant(4, "that remain to calibrate from; else none is held back")
    most_read: int = constant(720, "frames read: a longer recording is thinned out evenly")
    most_candidates: int = constant(
        240, "frames searched, the most informative; a frame of a camera takes 0.1 to 1 s"
    )
    least_met: float = constant(0.3, "of a frame's matchable detections; with less it is bad")
    undetermined: float = constant(
        0.25,
        "standard deviation by the size of the unknown (the rig, a focal length, a turn of 1 rad) "
        "from which a direction is not determined",
    )
    far: float = constant(
        3.0, "deviations by which a lens is moved, to see whether the fit gets worse"
    )
    flat: float = constant(
        0.5, "of the expected loss of fit, below which a deviation is too small: right ones have 1"
    )
    rescaled: float = constant(
        0.05, "largest log scale by a known length: bodies are known to a few per cent"
    )
    widened: tuple[float, ...] = constant(
        (1.0, 2.5, 6.0),
        "blurs in σ_ε, tried in turn for sensors that determine no pose alone, until the rig can "
        "be adjusted: sensors 30 mm off need the second if σ_ε is 5 mm",
    )
    probes: int = constant(
        10, "frames by which that blur is chosen if each is searched by itself: 0.7 s each"
    )
    failed: float = constant(
        1.9, "σ_ε of noise from which a calibration failed: estimates end at 2"
    )
    certain: float = constant(
        0.8,
        "least share of the weight of pairs that are nearest to each other, if features are told "
        "apart: right rigs of simulated range sensors have 0.98 and more, wrong ones 0.4, ranges "
        "that do not tell tags apart 0.5",
    )
    by_chance: float = constant(
        1e-6,
        "probability of such a contradiction if held parameters are right: up to a hundred kinds "
        "are tested",
    )
    elsewhere: int = constant(4, "frames in which a sensor stands elsewhere: fewer are bad ones")
    left: float = constant(
        0.1, "of a change's evidence: what it leaves of others; else it is not the only change"
    )
    left_by_chance: float = constant(
        1e-3, "probability of the most that is left so: changes of all sensors are tried"
    )
    rising: float = constant(
        1.5,
        "largest ratio of the residual of frames held back to that of the others: with six or more "
        "frames held back it varies by 0.2",
    )
    believed: float = constant(0.3, "of the frames: with fewer sure poses, all are a start")
    explained: float = constant(
        0.5,
        "least share of a sensor's detections that poses explain: of fifteen cameras, right ones "
        "have 0.68 and more, those 2 and 5 degrees off 0.15",
    )
    least_detections: int = constant(8, "explained likewise: four points fit many poses")
    gap: float = constant(2.5, "frame intervals over which motion is interpolated")
    moved: float = constant(
        4.0, "standard deviations: in simulation no sensor that stays is that far off"
    )
    worse: float = constant(
        1.5, "times the residual of a new calibration, from which an old one no longer holds"
    )

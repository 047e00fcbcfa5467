"""Mutants of what a session may say wrongly: sizes, lenses, where sensors stand."""

from __future__ import annotations

from mutation.mutant import Mutant

MUTANTS = (
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
        "judgement-lenses-are-those-that-are-told",
        "judgement/mistakes.py",
        "/ matches.sigmas[:, None, None]",
        "* 1e-9",
        "poses are ok whose cameras were given without their distortion",
        ("test_judgement_mistakes.py",),
    ),
    Mutant(
        "judgement-what-frames-told-of-a-session-is-forgotten",
        "judgement/mistakes.py",
        "log_mistaken + max(known.log_odds, 0.0)",
        "log_mistaken",
        "a body known to be too large is ok where one camera alone sees it",
        ("test_judgement_mistakes.py",),
    ),
    Mutant(
        "judgement-sensors-stand-otherwise-in-each-frame",
        "judgement/mistakes.py",
        "if log_mistaken > alone[0] or pose.residual_ratio > 1:",
        "if False:",
        "a camera turned by a tenth of a degree is believed once its residuals pass for noise",
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
    Mutant(
        "judgement-mistakes-put-poses-off-that-do-not-give-way-to-them",
        "judgement/mistakes.py",
        "is_sensor * shift - moved",
        "-moved",
        "frames are in doubt for a camera that two others outvote",
        ("test_judgement_mistakes.py",),
    ),
    Mutant(
        "judgement-any-number-of-mistakes-may-be-made",
        "judgement/mistakes.py",
        "np.logaddexp(right.get(mistake.what, 0.0), harmless)",
        "0.0",
        "a camera that agrees is doubted as much as the one that is off",
        ("test_judgement_mistakes.py",),
    ),
    Mutant(
        "judgement-a-turned-camera-is-as-told",
        "judgement/mistakes.py",
        "math.log(p) + mistake.log_odds",
        "math.log(p) - abs(mistake.log_odds)",
        "two cameras of which one was turned agree about a wrong pose",
        ("test_turned_camera.py",),
    ),
    Mutant(
        "judgement-far-off-is-met",
        "judgement/acceptance.py",
        "close = replace(used, shares=np.where(is_off, 0.0, used.shares))",
        "close = used",
        "a sensor that meets the body far off by chance, and sees it elsewhere, agrees",
        ("test_faults.py",),
    ),
    Mutant(
        "judgement-noise-of-the-frame-is-far-off",
        "judgement/acceptance.py",
        "max(noise.get(name, 0.0), variance)",
        "max(0.0, variance)",
        "sensors that are off by as much as the noise of the frame seem to see the body elsewhere",
        ("test_faults.py",),
    ),
)

"""The paper's weighting: densities averaged around zero."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from detections import TRUTH, detect, drawn_everywhere

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from paper.weighting import weighted

from mixpose.body import Body
from mixpose.objective import PaperObjective
from mixpose.rigid import perturb
from mixpose.sensors import ParallelBeam


def test_weighting_around_zero_is_one_more_blur(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    # ∫ w(s) f(s) ds for a Gaussian w: f on densities whose variances have grown by that of w
    views = detect(parallel_cameras, paper_body, TRUTH, sigma=4.0)
    plain = drawn_everywhere(views, 4.0)
    s = plain[0].density.window.step * np.arange(-20, 21)
    w = np.exp(-0.5 * (s[:, None] ** 2 + s**2) / 3.0**2).astype(np.float32)
    averaged = [replace(term, density=weighted(term.density, w)) for term in plain]
    twists = np.random.default_rng(0).uniform(-1, 1, (30, 6)) * np.repeat([4.0, 0.03], 3)
    found, expected = (
        PaperObjective(terms, paper_body.sample(2)).value(perturb(TRUTH, twists))
        for terms in (averaged, drawn_everywhere(views, 5.0))
    )
    # truncated weights and grids of four points per σ leave a few per cent
    np.testing.assert_allclose(found, expected, rtol=0.04)


def test_weights_that_are_no_weights_are_refused(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    views = detect(parallel_cameras, paper_body, TRUTH, sigma=4.0)
    density = drawn_everywhere(views, 4.0)[0].density
    for w in (np.zeros((3, 3)), -np.ones((3, 3)), np.ones((2, 3))):
        with pytest.raises(ValueError, match="weights"):
            weighted(density, w.astype(np.float32))

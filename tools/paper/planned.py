"""The paper's systems as sessions to plan with: detections of single features, no frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mixpose.extraction.options import ExtractOptions
from mixpose.fit import EstimatorOptions
from mixpose.records import Floats
from mixpose.sensors import ParallelBeam
from mixpose.session import SensorSetup, Session, Start
from paper.systems import SCENARIOS, System, draw, pose

CAMERA_WIDTH = 3.0
"""σ_ε of cameras over what their features err by: then all of these draw the pose.  Ranges err by
their σ_ε."""


def planned(system: System, noise: float) -> Session:
    """A session of a system for features that err by as much in every sensor.

    Markers of the body err by its spread, which features show, too.
    """
    errs = float(np.hypot(noise, system.spread))
    setups = []
    for k, sensor in enumerate(system.sensors):
        is_camera = isinstance(sensor, ParallelBeam)
        setup = SensorSetup(
            name=f"{'camera' if is_camera else 'range'} {k + 1}",
            model="parallel" if is_camera else "lateration",
            sensor=sensor,
            source=(),
            times=None,
            fps=None,
            extract=ExtractOptions(sigma=errs * (CAMERA_WIDTH if is_camera else 1.0)),
            resolution=sensor.resolution if isinstance(sensor, ParallelBeam) else None,
        )
        setups.append(setup)
    return Session(
        path=Path(f"system {system.name}"),
        sha256="",
        unit="mm",
        body=system.body(SCENARIOS[0]),
        start=Start(paper_poses(1)[0]),
        estimator=EstimatorOptions(),
        sensors=tuple(setups),
    )


def paper_poses(count: int, seed: int = 0) -> Floats:
    """Poses (P, 4, 4) drawn as for the accuracy evaluation."""
    rng = np.random.default_rng(seed)
    return np.array([pose(draw(rng)[0]) for _ in range(count)])

"""Predicted accuracy held against simulated frames: the paper's systems and a two-camera rig.

    python tools/design_study.py [--runs 1000] [--seed 0] [--noise 0.25] [--system 3]
                                 [--workers 2 | --scheduler ADDRESS]

For each system: errors of simulated frames over predicted ones, with what chance alone makes of
them; and what the lateration system must err by to be as accurate as the camera system, confirmed.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from paper.planned import paper_poses, planned
from paper.systems import systems

from mixpose.design import (
    Confirmation,
    Plan,
    confirm,
    noise_to_equal,
    plan_of,
    predict,
    spread_poses,
)
from mixpose.design.advice import scaled
from mixpose.design.prediction import pooled
from mixpose.executing import Executor, executor
from mixpose.records import Floats
from mixpose.session import Session, load_session

TWO_CAMERAS = Path(__file__).resolve().parents[1] / "data" / "synthetic" / "two_cameras"
POSES = 8
ORIGIN = np.zeros(3)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=0.25, help="σ_ε, px and length units")
    parser.add_argument("--system", type=int, choices=(1, 2, 3, 4), help="only this one")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--scheduler", help="address of a dask.distributed scheduler, or local")
    asked = parser.parse_args(arguments)
    with executor(asked.scheduler, asked.workers) as workers:
        studied(asked, workers)
    return 0


def studied(asked: argparse.Namespace, workers: Executor) -> None:
    """Print a row for each system, and what equals what."""
    print("| system | markers err by | overall | by chance | x | y | z | rx | ry | rz | ok | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    poses = paper_poses(POSES, asked.seed)
    spread = asked.noise
    cases: list[tuple[str, Session, Plan, Floats]] = []
    for system in systems(spread):
        session = planned(system, asked.noise)
        cases.append((f"system {system.name}", session, with_noise(session, asked.noise), poses))
    rig = load_session(TWO_CAMERAS / "session.toml")
    cases.append(("two pinholes", rig, plan_of(rig), spread_poses(rig, POSES, seed=asked.seed)))
    chosen = cases if asked.system is None else [cases[asked.system - 1]]
    for name, session, plan, at in chosen:
        began = time.perf_counter()
        found = confirm(
            session, plan, at, asked.runs, tip=ORIGIN, seed=asked.seed, executor=workers
        )
        print(row(name, plan, found, time.perf_counter() - began), flush=True)
    if asked.system is None:
        session = planned(systems(0.0)[2], asked.noise)
        ranges = with_noise(session, asked.noise)
        print(equality(cases[0][2], ranges, session, poses, asked, workers))


def with_noise(session: Session, noise: float) -> Plan:
    plan = plan_of(session)
    return replace(plan, noises=(noise,) * len(plan.noises))


def row(name: str, plan: Plan, found: Confirmation, seconds: float) -> str:
    ratios = " | ".join(f"{ratio:.3f}" for ratio in found.ratios)
    ok = found.statuses.get("ok", 0)
    return (
        f"| {name} | {plan.body.spread:g} | {found.overall:.3f} | ± {found.chance:.3f} | {ratios} "
        f"| {ok}/{found.frames} | {seconds:.0f} |"
    )


def equality(
    cameras: Plan,
    ranges: Plan,
    session: Session,
    poses: Floats,
    asked: argparse.Namespace,
    workers: Executor,
) -> str:
    """What the lateration system must err by, predicted and then simulated."""

    def error_of(plan: Plan) -> float:
        variances = np.einsum("pii->pi", predict(plan, poses).covariances)
        return pooled(np.sqrt(variances[:, :3].sum(axis=1)))

    wanted = error_of(cameras)
    factor = noise_to_equal(ranges, wanted, error_of)
    assert factor is not None, "without marker errors any accuracy can be had"
    equal = scaled(ranges, factor)
    found = confirm(
        session, equal, poses, asked.runs, tip=ORIGIN, seed=asked.seed, executor=workers
    )
    return (
        f"\nlateration with sigma = {equal.noises[0]:.4g} ({factor:.4g} times {asked.noise:g}) "
        f"equals the cameras: position {wanted:.4g} predicted, {found.found[0]:.4g} simulated"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

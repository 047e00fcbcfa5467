"""Judgement: which features a pose meets, what that is worth, and whether it is believed."""

from __future__ import annotations

from mixpose.judgement.acceptance import (
    APART,
    AcceptanceRules,
    Checks,
    Verdict,
    assess,
    contradict,
    decide,
    insert,
    is_far_off,
)
from mixpose.judgement.evidence import (
    DetectionModel,
    Prior,
    flat_prior,
    odds_of,
    paid_by_count,
)
from mixpose.judgement.expected_covariance import expected_covariance, invert_information
from mixpose.judgement.judge import (
    Case,
    JudgementRules,
    ScoredPose,
    beliefs,
    judge,
    judge_together,
    nearest_alike,
)
from mixpose.judgement.noise import NoiseModel, RememberedNoise

__all__ = [
    "APART",
    "AcceptanceRules",
    "Case",
    "Checks",
    "DetectionModel",
    "JudgementRules",
    "NoiseModel",
    "Prior",
    "RememberedNoise",
    "ScoredPose",
    "Verdict",
    "assess",
    "beliefs",
    "contradict",
    "decide",
    "expected_covariance",
    "flat_prior",
    "insert",
    "invert_information",
    "is_far_off",
    "judge",
    "judge_together",
    "nearest_alike",
    "odds_of",
    "paid_by_count",
]

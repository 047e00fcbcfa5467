"""Judgement: which features a pose meets, what that is worth, and whether it is believed."""

from mixpose.judgement.acceptance import (
    APART as APART,
    AcceptanceRules as AcceptanceRules,
    Verdict as Verdict,
    contradict as contradict,
    convinces as convinces,
    decide as decide,
    insert as insert,
    is_far_off as is_far_off,
    is_possible as is_possible,
    is_sure as is_sure,
)
from mixpose.judgement.covariance import (
    expected_covariance as expected_covariance,
    inverses as inverses,
    invert_information as invert_information,
)
from mixpose.judgement.evidence import (
    DetectionModel as DetectionModel,
    Prior as Prior,
    flat_prior as flat_prior,
    odds_of as odds_of,
    paid_by_count as paid_by_count,
)
from mixpose.judgement.judge import (
    JudgementRules as JudgementRules,
    ScoredPose as ScoredPose,
    beliefs as beliefs,
    judge as judge,
    judge_together as judge_together,
    nearest_alike as nearest_alike,
)
from mixpose.judgement.noise import NoiseModel as NoiseModel, RememberedNoise as RememberedNoise

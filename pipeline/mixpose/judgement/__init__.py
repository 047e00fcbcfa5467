"""Judgement: noise, covariance and evidence of a pose, and the decision about a frame."""

from mixpose.judgement.acceptance import (
    LEAST_BELIEF as LEAST_BELIEF,
    AcceptanceRules as AcceptanceRules,
    Alternative as Alternative,
    Second as Second,
    Verdict as Verdict,
    ahead as ahead,
    beliefs as beliefs,
    convinces as convinces,
    decide as decide,
    insert as insert,
    is_far_off as is_far_off,
    is_open as is_open,
    is_possible as is_possible,
    is_sure as is_sure,
    unconfirming_sensors as unconfirming_sensors,
    nearest_alike as nearest_alike,
    is_seen_elsewhere as is_seen_elsewhere,
    has_two_agreeing as has_two_agreeing,
)
from mixpose.judgement.evidence import (
    DetectionModel as DetectionModel,
    Prior as Prior,
    flat_prior as flat_prior,
    odds_of as odds_of,
    paid_by_count as paid_by_count,
)
from mixpose.judgement.judge import (
    MEETS_NOTHING as MEETS_NOTHING,
    Case as Case,
    JudgementRules as JudgementRules,
    ScoredPose as ScoredPose,
    judge as judge,
    judge_together as judge_together,
)
from mixpose.judgement.clutter import ClutterRates as ClutterRates
from mixpose.judgement.information import (
    expected_covariance as expected_covariance,
    invert_information as invert_information,
    inverted as inverted,
)
from mixpose.judgement.nonlinear import (
    Curved as Curved,
    with_likely_turns as with_likely_turns,
    with_wide_turn as with_wide_turn,
)
from mixpose.judgement.mistakes import (
    APART as APART,
    Mistake as Mistake,
    odds_of_mistakes as odds_of_mistakes,
    possible_mistakes as possible_mistakes,
)
from mixpose.judgement.shape import Shape as Shape, shape_shown as shape_shown
from mixpose.judgement.noise import NoiseModel as NoiseModel, RememberedNoise as RememberedNoise

"""What can be switched off: a proposer, a refinement, or a rule at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from mixpose.judgement import DetectionModel
from mixpose.objective import View
from mixpose.tracking import Rules, Track, Tracker
from mixpose.tracking.frame import Frame
from mixpose.tracking.proposers import Proposer, multistart, searched
from mixpose.tracking.refinements import Refinement, agreed, all_near, merged_pair, without_sensor

FREE = 0.0
NEVER = float("inf")
NEVER_STATIC = 1_000_000  # frames


@dataclass(frozen=True)
class FreeMisses(DetectionModel):
    """Features without a detection cost nothing."""

    @property
    def log_missed(self) -> float:
        """Of a feature in view without a detection."""
        return FREE


@dataclass(frozen=True)
class Switch:
    """Something that is switched off.

    Attributes
    ----------
    name : str
        What is left without it.
    change : callable
        From a tracker with everything on to one without.
    """

    name: str
    change: Callable[[Tracker], Tracker]


def without_proposer(proposer: Proposer) -> Callable[[Tracker], Tracker]:
    def change(tracker: Tracker) -> Tracker:
        kept = tuple(one for one in tracker.proposers if one is not proposer)
        return replace(tracker, proposers=kept)

    return change


def without_refinement(refinement: Refinement) -> Callable[[Tracker], Tracker]:
    def change(tracker: Tracker) -> Tracker:
        kept = tuple(one for one in tracker.refinements if one is not refinement)
        return replace(tracker, refinements=kept)

    return change


def ruled(group: str, **fields: Any) -> Callable[[Tracker], Tracker]:
    """Fields of a group of rules replaced, as ``ruled("judgement.noise", memory=0.0)``."""

    def changed(rules: Any, names: list[str]) -> Any:
        if not names:
            return replace(rules, **fields)
        return replace(rules, **{names[0]: changed(getattr(rules, names[0]), names[1:])})

    def change(tracker: Tracker) -> Tracker:
        rules: Rules = changed(tracker.rules, group.split("."))
        return replace(tracker, rules=rules)

    return change


def free_misses(tracker: Tracker) -> Tracker:
    judgement = replace(tracker.rules.judgement, detection=FreeMisses())
    return replace(tracker, rules=replace(tracker.rules, judgement=judgement))


class AtOneMoment(Tracker):
    """Sensors are taken to see the body at the common time, all rows at once."""

    def data(self, track: Track, frame: int, time_s: float | None, views: Sequence[View]) -> Frame:
        """A frame, and what is known before it."""
        views = [replace(view, delay=0.0, readout=0.0, unsure=None) for view in views]
        return super().data(track, frame, time_s, views)


def at_one_moment(tracker: Tracker) -> Tracker:
    return AtOneMoment(**{field.name: getattr(tracker, field.name) for field in fields(tracker)})


def unfused(tracker: Tracker) -> Tracker:
    return replace(tracker, options=replace(tracker.options, fuse=False))


SWITCHES = (
    Switch("no multistart", without_proposer(multistart)),
    Switch("no searched", without_proposer(searched)),
    Switch("static clutter searched alike", ruled("proposals", static=NEVER_STATIC)),
    Switch("no congruent features", ruled("look_alikes", kinds=("tilted", "mirrored"))),
    Switch("no other tilt", ruled("look_alikes", kinds=("congruent", "mirrored"))),
    Switch("no mirror image", ruled("look_alikes", kinds=("congruent", "tilted"))),
    Switch("no merged_pair", without_refinement(merged_pair)),
    Switch("no all_near", without_refinement(all_near)),
    Switch("no agreed", without_refinement(agreed)),
    Switch("sizes tell nothing", ruled("sizes", cut=0.0)),
    Switch("no without_sensor", without_refinement(without_sensor)),
    Switch("nothing merged", ruled("judgement.association", merged=False)),
    Switch("misses free", free_misses),
    Switch("unseen free", ruled("judgement.detection", log_unseen=FREE)),
    Switch("clutter even", ruled("judgement.association", crowded=False)),
    Switch("payment by volume", ruled("judgement.detection", by_count=False)),
    Switch("prior flat", ruled("motion", surprise=1.0)),
    Switch("no velocity", ruled("motion", coasting=-1)),
    Switch("no fusion of ranges", unfused),
    Switch("noise: no memory", ruled("judgement.noise", memory=0.0)),
    Switch("noise: no outdone", ruled("judgement.noise", known=NEVER)),
    Switch("noise: no typical", ruled("judgement.noise.errors", typical_degrees=1e-3)),
    Switch("noise: no offsets before they are seen", ruled("judgement.noise", lasting=0.0)),
    Switch("noise: nothing lasts", ruled("judgement.noise", bias=0.0)),
    Switch("blurs end at σ_ε", ruled("judgement.noise.errors", narrowest=1.0)),
    Switch("noise of few residuals as of many", ruled("judgement.noise", fewest_degrees=1e12)),
    Switch("late sensors taken as in time", at_one_moment),
    Switch("features equally bright", ruled("fit", unlike=0.0)),
    Switch("misfit taken for noise", ruled("fit", believed=1.0)),
    Switch("blurs always", ruled("fit", near=NEVER)),
    Switch("blurs never", ruled("fit", near=0.0)),
    Switch("not looked elsewhere", ruled("acceptance", convincing=0.0)),
    Switch("nothing doubted", ruled("acceptance", confidence=1e-9)),
    Switch("any turn sure", ruled("acceptance", widest_turn_deg=NEVER)),
)

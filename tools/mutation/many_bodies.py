"""Mutants of what finds many bodies, tells equal ones apart, and notices one too many."""

from __future__ import annotations

from mutation.mutant import Mutant

_COPIES = "test_search_copies.py"
_IDENTITY = "test_tracking_identity.py"
_TWIN = "test_tracking_twin.py"
_SCENE = "test_several_bodies_scene.py"

MUTANTS = (
    Mutant(
        "search-copies-share-markers",
        "search/copies.py",
        "if len(others) <= (1 - budget.convincing) * len(rows[k]):",
        "if True:",
        "bodies are found where others are already",
        (_COPIES,),
    ),
    Mutant(
        "search-copies-of-one-kind-only",
        "search/copies.py",
        "for problem, own in zip(problems, triangles, strict=True)",
        "for problem, own in zip(problems, triangles[:1] * len(problems), strict=True)",
        "only bodies like the first are found at once",
        (_COPIES,),
    ),
    Mutant(
        "search-copies-without-rivals",
        "search/copies.py",
        "rivals[j] = k",
        "pass",
        "a pose that might be another one is told as if it were sure",
        (_COPIES,),
    ),
    Mutant(
        "tracking-identity-by-motion-alone",
        "tracking/identity.py",
        "beside = terms.sum(axis=2) - terms[i, :, i] - terms[:, i, i]",
        "beside = 0.0 * terms.sum(axis=2)",
        "bodies that move together farther than they are apart change numbers",
        (_IDENTITY,),
    ),
    Mutant(
        "tracking-identity-new-distances-cost-nothing",
        "tracking/identity.py",
        "np.where(np.isnan(off), -math.log(self.room), known)",
        "np.where(np.isnan(off), 0.0, known)",
        "a body that was never seen takes the place of one that is followed",
        (_IDENTITY,),
    ),
    Mutant(
        "tracking-identity-old-distances-as-sure-as-new-ones",
        "tracking/identity.py",
        "* (1 + before.missed) ** 2",
        "",
        "a body that comes back elsewhere gets another's number",
        (_IDENTITY,),
    ),
    Mutant(
        "tracking-identity-distances-forgotten",
        "tracking/motion.py",
        "np.where(is_seen, now, self.last),",
        "now,",
        "a body that was hidden takes another one's number",
        (_IDENTITY,),
    ),
    Mutant(
        "tracking-twin-never-sought",
        "tracking/twin.py",
        'if best is None or verdict.status != "ok":',
        "if True:",
        "a mirror image is followed while the body itself is in view",
        (_TWIN,),
    ),
    Mutant(
        "tracking-twin-forgotten",
        "tracking/tracker.py",
        "other = -second.either if second and one is second.pose else",
        "other = None if second and one is second.pose else",
        "what stood beside the body is ok when the body goes",
        (_TWIN,),
    ),
    Mutant(
        "tracking-twin-among-what-is-met",
        "tracking/twin.py",
        "is_left[numbers[view.name][numbers[view.name] >= 0]] = False",
        "pass",
        "a body is its own mirror image",
        (_TWIN,),
    ),
    Mutant(
        "tracking-mirrors-that-nobody-asks-for",
        "tracking/doubt.py",
        "if data.options.mirrors and is_flat(data):",
        "if is_flat(data):",
        "a flat body is never ok",
        (_TWIN,),
    ),
    Mutant(
        "tracking-mirrors-not-believed",
        "tracking/doubt.py",
        "if data.options.mirrors and is_flat(data):",
        "if False:",
        "a flat body is ok where there are mirrors",
        (_TWIN,),
    ),
    Mutant(
        "tracking-those-away-are-sought-in-every-frame",
        "tracking/sharing.py",
        "if not self.looked or is_due:",
        "if True:",
        "bodies that are there wait for those that are not",
        (_SCENE,),
    ),
)

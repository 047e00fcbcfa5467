"""What the user says about feature extraction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mixpose.errors import SessionError


@dataclass(frozen=True)
class ExtractOptions:
    """Options of feature extraction; the keys of ``[extract]`` in a session file.

    Attributes
    ----------
    method : str
        "blobs", "corners", "intensity", "log", or "module:function" for the user's own.
    polarity : {"bright", "dark"}
        Whether features are brighter or darker than their surroundings.
    threshold : str or float
        "auto", "otsu", "local", "li", "triangle", "sauvola", or a grey level in the units of the
        image.
    min_area, max_area : float
        Limits of a blob's area in px; `max_area` None means no limit.
    sigma : float
        σ_ε, standard deviation of the feature extraction: px for cameras, length units for
        lateration.
    spot_sigma : float
        Standard deviation that a feature has already in grey values ("intensity") and in range
        profiles, same units as `sigma`; 0 where it is much smaller than `sigma`.  Width of the
        spots that "log" looks for, in px; 0 for 3 px.
    """

    method: str = "blobs"
    polarity: Literal["bright", "dark"] = "bright"
    threshold: str | float = "auto"
    min_area: float = 3.0
    max_area: float | None = None
    sigma: float = 1.5
    spot_sigma: float = 0.0


def check_level(threshold: str | float, method: str, meaning: str) -> None:
    """Refuse rules for a threshold where only "auto" and a grey level have a meaning.

    Raises
    ------
    SessionError
        Names the method, and the meaning that a grey level has there.
    """
    if isinstance(threshold, str) and threshold != "auto":
        raise SessionError(
            f"extract.threshold: {threshold!r} does not go with method {method!r};"
            f' allowed are "auto" and a grey level, {meaning}'
        )

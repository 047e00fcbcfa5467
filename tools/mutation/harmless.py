"""Mutants by rule that no test need notice, each with the reason.

They are known by their file and their line without and with the change, wherever that stands.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Harmless:
    """A mutant that changes nothing that anybody is promised.

    Attributes
    ----------
    file : str
        Below `pipeline/mixpose`.
    old, new : str
        The line without and with the change, without its indentation.
    reason : str
    """

    file: str
    old: str
    new: str
    reason: str


GUARDED = "zip(strict=True) only guards against lists that the code made of different lengths"

HARMLESS: tuple[Harmless, ...] = (
    Harmless(
        "calibration/latecomers.py",
        "_MOST = 1_000_000  # detections of a frame",
        "_MOST = 1000001  # detections of a frame",
        "any number above that of the detections of a frame will do",
    ),
    Harmless(
        "checking/evidence.py",
        "@dataclass(frozen=True)",
        "@dataclass(frozen=False)",
        "only guards against assignments, which mypy finds too",
    ),
    Harmless(
        "checking/placement.py",
        "_TRIED = 64",
        "_TRIED = 128",
        "only speed: more orientations are tried",
    ),
    Harmless(
        "design/advice.py",
        "if excess(low) > 0 or excess(high) < 0:",
        "if excess(low) >= 0 or excess(high) < 0:",
        "errors that are equal to the last bit",
    ),
    Harmless(
        "pictures/plots.py",
        "places = np.stack([ranges, np.zeros_like(ranges)], axis=-1)",
        "places = np.stack([ranges, np.zeros_like(ranges)], axis=+1)",
        "equivalent: of two arrays of one axis",
    ),
    Harmless(
        "poses/trajectories.py",
        "@dataclass(frozen=True, eq=False)",
        "@dataclass(frozen=False, eq=False)",
        "only guards against assignments, which mypy finds too",
    ),
    Harmless(
        "publishing/channel.py",
        'buffer: int = constant(2**16, "bytes that the system holds of a connection: '
        'some 20 poses")',
        'buffer: int = constant(2*16, "bytes that the system holds of a connection: '
        'some 20 poses")',
        "only how many poses wait in the system, which takes no less than some kB",
    ),
    Harmless(
        "publishing/ros2.py",
        "_DEPTH = 10  # of the queues of publishers, as in ROS's examples",
        "_DEPTH = 11  # of the queues of publishers, as in ROS's examples",
        "only how many messages wait, as in examples of ROS",
    ),
    Harmless(
        "search/from_points.py",
        "cuts[:, i] = False",
        "cuts[:, i] = True",
        "more guesses, which are judged as all others are",
    ),
    Harmless(
        "search/search.py",
        "if self._are_enough(poses[:3], best):",
        "if self._are_enough(poses[:4], best):",
        "only speed: a fourth guess is refined at once",
    ),
    Harmless(
        "simulation/visible_spots.py",
        "return np.asarray(((body.normals @ R.T) * sensor.towards(points)).sum(axis=-1) > 0)",
        "return np.asarray(((body.normals @ R.T) * sensor.towards(points)).sum(axis=-1) >= 0)",
        "a face is exactly edge-on only by rounding",
    ),
    Harmless(
        "trajectories/pivot.py",
        "information = np.eye(6)",
        "information = np.eye(12)",
        "equivalent: it is replaced in the first step",
    ),
)

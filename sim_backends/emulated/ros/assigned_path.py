"""Path on which the lab moves a robot, and the file in which the robot stores its paths."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from fieldkit.core.model import Vector


@dataclass(frozen=True)
class AssignedPath:
    """Path on which the lab moves a robot. The robot stops at the end of the path.

    On a path of one point, the robot stays at this point.

    Attributes:
        start_ns: Start of the motion, as a time of the monotonic clock, which is common to all robots on one machine.
        points_m: Points of the path, metres east, north, up.
        speed_m_s: Horizontal speed.
        facing_rad: Heading of the robot before the start, from east towards north.
    """

    start_ns: int
    points_m: Sequence[Vector]
    speed_m_s: float
    facing_rad: float


def append_path(file_path: Path, path: AssignedPath) -> None:
    """Append a path to the file that a robot's sensors read."""
    with file_path.open("a", encoding="ascii") as file:
        file.write(json.dumps(asdict(path)) + "\n")

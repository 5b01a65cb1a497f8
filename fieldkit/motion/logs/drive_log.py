"""Log of an autonomous drive of a ground robot, and its columns.

fieldkit's agent on the robot writes a JSON object per line, ten times a second (`fieldkit.agent.driving.drive`):
time, pose from odometry in the frame of the start, and driven distance. If the program was not killed, the last line
contains the reason for the end. All values are measurements of the robot.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import shorten
from fieldkit.motion.logs import motion_log
from fieldkit.motion.logs.motion_log import LAST_NS, LONGEST_M, LONGEST_S

FILE: Final = "drive.jsonl"

HOME: Final = "home"
"""Value of `ended` for a drive that returned to its start without being stopped."""

COLUMNS: Final = columns(
    100,
    (
        "drive_out_m",
        "m",
        "Distance driven until the robot turned back. Distances, speeds and headings of a drive are from odometry.",
        Figure("distance driven", Kind.MEDIAN),
    ),
    ("drive_farthest_m", "m", "Largest distance of the robot from its starting position."),
    (
        "drive_speed_median_m_s",
        "m/s",
        "Median speed of the robot on the outward path, each over half a second; empty for a shorter path.",
        Figure("drive speed", Kind.MEDIAN),
    ),
    ("drive_speed_max_m_s", "m/s", "Largest speed of the robot over half a second, on outward and return path."),
    (
        "drive_back_off_m",
        "m",
        "Distance of the robot from its starting position after its return; empty if it did not return.",
        Figure("position error", Kind.MEDIAN),
    ),
    (
        "drive_back_turned_rad",
        "rad",
        "Heading of the robot after its return relative to the start, positive to the left.",
        (-math.pi, math.pi),
    ),
    (
        "drive_ended",
        "text",
        "End of the drive: home, or the reason for a stop on its path. Empty if the log is incomplete.",
    ),
)
"""Columns of trials with self-driving robots."""

_OUT: Final = frozenset({"out", "there"})
"""Phases from the start of the path until the robot turns back."""
_PHASES: Final = frozenset({"waits", "returns", "back", HOME}) | _OUT
_SPEED_INTERVAL_S: Final = 0.5
"""Interval over which a speed is computed. One odometry message more or less changes it by 4 % at 50 Hz and by 7 %
at 30 Hz."""
_ROUNDING: Final = 1e-4
"""Largest error of a rounded heading in the log, in radians."""


@dataclass(frozen=True)
class DriveMoment:
    """A line of the log.

    Attributes:
        at_s: Time since the start of the program.
        phase: Phase of the drive: `waits` before the start, `returns` if the robot first drives to its origin, `out`
            on the path, `there` at its end, `back` on the return path, or `home`.
        x_m: Position ahead of the start.
        y_m: Position to the left of the start.
        yaw_rad: Heading relative to the start, positive to the left.
        driven_m: Driven distance since the start.
        forward_m_s: Commanded speed; 0 while the robot is stationary or turns.
        ended: Reason for the end; empty before the end.
        utc_ns: Time by the robot's clock, nanoseconds since 1970 UTC; 0 if the line does not have it.
    """

    at_s: float
    phase: str
    x_m: float
    y_m: float
    yaw_rad: float
    driven_m: float
    forward_m_s: float
    ended: str = ""
    utc_ns: int = 0

    @property
    def distance_m(self) -> float:
        """Distance from the start."""
        return math.hypot(self.x_m, self.y_m)


def read(path: Path) -> tuple[DriveMoment, ...]:
    """Return the lines of a log in chronological order; an incomplete last line is omitted.

    Raises:
        EvidenceError: The log is missing, empty, has an invalid line, or its lines are not in order.
    """
    log = motion_log.read(path, _parse_moment, "drive")
    if any(after.driven_m < before.driven_m for before, after in pairwise(log)):
        raise EvidenceError("its driven distance decreases, so its lines are not in order", where=str(path))
    return log


def _parse_moment(fields: Mapping[str, Any]) -> DriveMoment:
    """Convert the JSON object of a line; raises one of `JSON_ERRORS` if it is invalid."""
    at_s, driven_m, forward_m_s = (float(fields[name]) for name in ("at_s", "driven_m", "forward_m_s"))
    x_m, y_m, yaw_rad = (float(fields[name]) for name in ("x_m", "y_m", "yaw_rad"))
    phase, ended, utc_ns = fields["phase"], fields["ended"], int(fields.get("utc_ns", 0))
    is_possible = (
        0 <= at_s <= LONGEST_S
        and 0 <= driven_m <= LONGEST_M
        and math.hypot(x_m, y_m) <= LONGEST_M
        and math.isfinite(forward_m_s)
        and abs(yaw_rad) <= math.pi + _ROUNDING
        and phase in _PHASES
        and isinstance(ended, str)
        and 0 <= utc_ns < LAST_NS
    )
    if not is_possible:
        raise ValueError(fields)
    yaw_rad = max(-math.pi, min(yaw_rad, math.pi))
    return DriveMoment(at_s, phase, x_m, y_m, yaw_rad, driven_m, forward_m_s, shorten(ended), utc_ns)


def measure(log: Sequence[DriveMoment] | None) -> Measured:
    """Return the columns; all are missing if there is no log."""
    if not log:
        return Measured.all_missing(COLUMNS, "the robot wrote no log of its drive")
    outward = [record for record in log if record.phase in _OUT]
    home = log[-1] if log[-1].ended == HOME else None
    outward_speeds_m_s = speeds_m_s([record for record in outward if record.phase == "out"])
    all_speeds_m_s = (*outward_speeds_m_s, *speeds_m_s([record for record in log if record.phase == "back"]))
    values: dict[str, Value | None] = {
        "drive_out_m": outward[-1].driven_m if outward else None,
        "drive_farthest_m": max(record.distance_m for record in log),
        "drive_speed_median_m_s": float(np.median(outward_speeds_m_s)) if outward_speeds_m_s else None,
        "drive_speed_max_m_s": max(all_speeds_m_s, default=None),
        "drive_back_off_m": None if home is None else home.distance_m,
        "drive_back_turned_rad": None if home is None else home.yaw_rad,
        "drive_ended": log[-1].ended or None,
    }
    return Measured.from_optional(values, "the log has no line of this phase of the drive")


def speeds_m_s(log: Sequence[DriveMoment]) -> list[float]:
    """Return the speeds over half a second in m/s, one for each line at which the half second starts.

    A speed is omitted if the robot was not commanded to move at the start or at the end of the half second.
    """
    times_s = [record.at_s for record in log]
    pairs = ((record, bisect_left(times_s, record.at_s + _SPEED_INTERVAL_S)) for record in log if record.forward_m_s)
    return [
        (log[later].driven_m - record.driven_m) / (log[later].at_s - record.at_s)
        for record, later in pairs
        if later < len(log) and log[later].forward_m_s
    ]

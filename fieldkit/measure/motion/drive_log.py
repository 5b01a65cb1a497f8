"""Log of a ground robot on a way that it drove by itself, and the columns of it.

The robot's agent writes a JSON object a line, ten times a second (`fieldkit.agent.drive`): when, where it is by its
own odometry, seen from where it began and as it faced there, and how far its wheels took it. The last line says how
it ended. All of it is the robot's word.
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
from fieldkit.core.text import brief
from fieldkit.measure.motion import motion_log
from fieldkit.measure.motion.motion_log import LAST_NS, LONGEST_M, LONGEST_S

FILE: Final = "drive.jsonl"

HOME: Final = "home"
"""How a drive ends that nothing stopped."""

COLUMNS: Final = columns(
    100,
    (
        "drive_out_m",
        "m",
        "How far it drove by its odometry, as all that follows, until it turned back.",
        Figure("distance driven", Kind.MEDIAN),
    ),
    ("drive_farthest_m", "m", "How far from its place its odometry had it at most."),
    (
        "drive_speed_median_m_s",
        "m/s",
        "Median of its speed while it drove on the way out, over half a second at a time; empty of a shorter way.",
        Figure("drive speed", Kind.MEDIAN),
    ),
    ("drive_speed_max_m_s", "m/s", "Largest of these speeds, there and back."),
    (
        "drive_back_off_m",
        "m",
        "How far from its place its odometry had it after it came back; empty where it did not.",
        Figure("position error", Kind.MEDIAN),
    ),
    (
        "drive_back_turned_rad",
        "rad",
        "How far to the left it was turned then from how it faced in the beginning.",
        (-math.pi, math.pi),
    ),
    ("drive_ended", "text", "What ended it: home, or what stopped it on its way. Empty where it was cut short."),
)
"""In trials whose robots drive by themselves."""

_OUT: Final = frozenset({"out", "there"})
_PHASES: Final = frozenset({"waits", "back", HOME}) | _OUT
_SPAN_S: Final = 0.5
"""Speeds are over so long: a message of odometry more or less is 3 % of it at 50 a second, and 7 % at 30."""
_ROUNDING: Final = 1e-4


@dataclass(frozen=True)
class DriveMoment:
    """A line of the log.

    Attributes:
        at_s: When, since it was started.
        phase: What it was about: `waits`, `out`, `there`, `back` or `home`.
        x_m: How far ahead of where it began it was.
        y_m: And to the left of that.
        yaw_rad: How far to the left it was turned since.
        driven_m: How far its wheels took it, there and back.
        forward_m_s: How fast it was told to drive; 0 where it stands or turns.
        ended: How it ended; empty while it had not.
        utc_ns: When by the robot's clock, nanoseconds since 1970 UTC; 0 if the line does not say.
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
    def off_m(self) -> float:
        """How far it was from where it began."""
        return math.hypot(self.x_m, self.y_m)


def read(path: Path) -> tuple[DriveMoment, ...]:
    """Return the lines of a log in the order of time; a last one that is not whole is left out.

    Raises:
        EvidenceError: It is missing, has no line, or one that no driver writes.
    """
    log = motion_log.read(path, _moment, "the robot drove")
    if any(after.driven_m < before.driven_m for before, after in pairwise(log)):
        raise EvidenceError("its lines are not in the order of time", where=str(path))
    return log


def _moment(said: Mapping[str, Any]) -> DriveMoment:
    """Return what a line says; raises what `motion_log.read` catches."""
    at_s, driven_m, forward_m_s = (float(said[name]) for name in ("at_s", "driven_m", "forward_m_s"))
    x_m, y_m, yaw_rad = (float(said[name]) for name in ("x_m", "y_m", "yaw_rad"))
    phase, ended, utc_ns = said["phase"], said["ended"], int(said.get("utc_ns", 0))
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
        raise ValueError(said)
    yaw_rad = max(-math.pi, min(yaw_rad, math.pi))
    return DriveMoment(at_s, phase, x_m, y_m, yaw_rad, driven_m, forward_m_s, brief(ended), utc_ns)


def measure(log: Sequence[DriveMoment] | None) -> Measured:
    """Return the columns; all are missing where there is no log."""
    if not log:
        return Measured.nothing(COLUMNS, "the robot did not write down how it drove")
    out = [record for record in log if record.phase in _OUT]
    home = log[-1] if log[-1].ended == HOME else None
    out_m_s = speeds_m_s([record for record in out if record.phase == "out"])
    all_speeds_m_s = (*out_m_s, *speeds_m_s([record for record in log if record.phase == "back"]))
    values: dict[str, Value | None] = {
        "drive_out_m": out[-1].driven_m if out else None,
        "drive_farthest_m": max(record.off_m for record in log),
        "drive_speed_median_m_s": float(np.median(out_m_s)) if out_m_s else None,
        "drive_speed_max_m_s": max(all_speeds_m_s, default=None),
        "drive_back_off_m": None if home is None else home.off_m,
        "drive_back_turned_rad": None if home is None else home.yaw_rad,
        "drive_ended": log[-1].ended or None,
    }
    return Measured.of(values, "its log does not go so far")


def speeds_m_s(log: Sequence[DriveMoment]) -> list[float]:
    """Return the speed in m/s from each moment until half a second later, where it was commanded to drive at both."""
    times_s = [record.at_s for record in log]
    pairs = ((record, bisect_left(times_s, record.at_s + _SPAN_S)) for record in log if record.forward_m_s)
    return [
        (log[later].driven_m - record.driven_m) / (log[later].at_s - record.at_s)
        for record, later in pairs
        if later < len(log) and log[later].forward_m_s
    ]

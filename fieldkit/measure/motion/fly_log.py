"""What the program that flew a drone wrote down of its flight, and the columns of it.

The agent writes a JSON object a line, ten times a second (`fieldkit.agent.flight_log`): when, what the flight was
about, and the position of the drone by its autopilot, relative to the origin of the trial's flights: the place and
heading of the first start. All of it is the drone's word. The first line has the origin.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.measure.motion import motion_log
from fieldkit.measure.motion.motion_log import LAST_NS, LONGEST_M, LONGEST_S

FILE: Final = "fly.jsonl"

_FASTEST_M_S: Final = 1e4
_HIGHEST: Final = (-LONGEST_M, LONGEST_M)
"""A drone may land below where it rose."""

COLUMNS: Final = columns(
    100,
    (
        "fly_height_median_m",
        "m",
        "Median of its height over where it rose, by its autopilot, as all that follows, while the steps inside ran.",
        Figure("flight height", Kind.MEDIAN),
        _HIGHEST,
    ),
    ("fly_height_max_m", "m", "Largest of its heights, of the whole flight.", _HIGHEST),
    (
        "fly_farthest_m",
        "m",
        "How far over the ground it was from where it rose at most.",
        Figure("farthest distance flown", Kind.MEDIAN),
    ),
    (
        "fly_speed_median_m_s",
        "m/s",
        "Median of its speed on its way; empty where it has none.",
        Figure("flight speed", Kind.MEDIAN),
    ),
    ("fly_speed_max_m_s", "m/s", "Largest of its speeds, of the whole flight."),
    ("fly_back_off_m", "m", "How far over the ground it was from where it rose when its motors stood again."),
)
"""In trials with a step `fly`."""

_ON_WAY: Final = "flying"
_LED: Final = frozenset({_ON_WAY, "there"})
"""Phases in which the steps inside run."""
_LAST: Final = "coming down"
PHASES: Final = ("standing", "climbing", "up", _ON_WAY, "there", "coming back", _LAST)
"""What a flight is about, in the order of time."""


@dataclass(frozen=True)
class FlightMoment:
    """A line of the log.

    Attributes:
        at_s: When, since it stood.
        phase: What the flight was about, `flying` for example.
        ahead_m: How far ahead of where it rose it was.
        left_m: And to the left of that.
        up_m: And above it.
        speed_m_s: How fast it moved.
        utc_ns: When by the clock of its computer, nanoseconds since 1970 UTC; 0 if the line does not say.
    """

    at_s: float
    phase: str
    ahead_m: float
    left_m: float
    up_m: float
    speed_m_s: float
    utc_ns: int = 0

    @property
    def off_m(self) -> float:
        """How far over the ground it was from where it rose."""
        return math.hypot(self.ahead_m, self.left_m)


def read(path: Path) -> tuple[FlightMoment, ...]:
    """Return the lines of a log in the order of time; a last one that is not whole is left out.

    Raises:
        EvidenceError: It is missing, has no line, or one that no flight writes.
    """
    return motion_log.read(path, _moment, "the drone flew")


def _moment(said: Mapping[str, Any]) -> FlightMoment | None:
    """Return a line's moment, None for the origin and the end; raises what `motion_log.read` catches."""
    if "ended" in said or "origin" in said:
        return None
    at_s, speed_m_s, utc_ns = float(said["at_s"]), float(said["speed_m_s"]), int(said.get("utc_ns", 0))
    ahead_m, left_m, up_m = (float(said[name]) for name in ("ahead_m", "left_m", "up_m"))
    is_possible = (
        0 <= at_s <= LONGEST_S
        and math.hypot(ahead_m, left_m, up_m) <= LONGEST_M
        and 0 <= speed_m_s <= _FASTEST_M_S
        and said["phase"] in PHASES
        and 0 <= utc_ns < LAST_NS
    )
    if not is_possible:
        raise ValueError(said)
    return FlightMoment(at_s, said["phase"], ahead_m, left_m, up_m, speed_m_s, utc_ns)


def measure(log: Sequence[FlightMoment] | None) -> Measured:
    """Return the columns; all are missing where there is no log."""
    if not log:
        return Measured.nothing(COLUMNS, "the drone did not write down how it flew")
    heights_m = [one.up_m for one in log if one.phase in _LED]
    speeds_m_s = [one.speed_m_s for one in log if one.phase == _ON_WAY]
    values: dict[str, Value | None] = {
        "fly_height_median_m": float(np.median(heights_m)) if heights_m else None,
        "fly_height_max_m": max(one.up_m for one in log),
        "fly_farthest_m": max(one.off_m for one in log),
        "fly_speed_median_m_s": float(np.median(speeds_m_s)) if speeds_m_s else None,
        "fly_speed_max_m_s": max(one.speed_m_s for one in log),
        "fly_back_off_m": log[-1].off_m if log[-1].phase == _LAST else None,
    }
    return Measured.of(values, "its log does not go so far")

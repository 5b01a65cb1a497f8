"""Log of a drone's flight, and its columns.

fieldkit's agent on the drone writes a JSON object per line, ten times a second (`fieldkit.agent.flying.flight_log`):
time, phase of the flight, and the autopilot's position estimate. Horizontal positions are relative to the origin of
the trial's flights, which is the position and heading before the first take-off of the trial. Heights are relative to
the ground from which the drone took off for the flight of the log. All values are measurements of the drone. The
first line contains the origin.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.agent.flying.flight_plan import AT_PATH_END, DESCENDING, ON_PATH, PHASES
from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.motion.logs import motion_log
from fieldkit.motion.logs.motion_log import LAST_NS, LONGEST_M, LONGEST_S

FILE: Final = "fly.jsonl"

_MAX_SPEED_M_S: Final = 1e4
_HEIGHT_BOUNDS_M: Final = (-LONGEST_M, LONGEST_M)
"""A height may be negative, because a drone can land below its take-off position."""

COLUMNS: Final = columns(
    100,
    (
        "fly_height_median_m",
        "m",
        (
            "Median height over the take-off position while the steps inside `fly` ran. All columns of a flight are "
            "values that the autopilot reported."
        ),
        Figure("flight height", Kind.MEDIAN),
        _HEIGHT_BOUNDS_M,
    ),
    ("fly_height_max_m", "m", "Largest height during the whole flight.", _HEIGHT_BOUNDS_M),
    (
        "fly_farthest_m",
        "m",
        (
            "Largest horizontal distance from the position of the drone's first take-off in the trial (in a "
            "campaign: at this place)."
        ),
        Figure("farthest distance flown", Kind.MEDIAN),
    ),
    (
        "fly_speed_median_m_s",
        "m/s",
        "Median speed of the drone while it flies its path, or, without a path, while it hovers.",
        Figure("flight speed", Kind.MEDIAN),
    ),
    ("fly_speed_max_m_s", "m/s", "Largest speed during the whole flight."),
    (
        "fly_back_off_m",
        "m",
        "Horizontal distance from the drone's first take-off (as in fly_farthest_m) when the motors had stopped.",
    ),
)
"""Columns of trials with a step `fly`."""

_STEP_PHASES: Final = frozenset({ON_PATH, AT_PATH_END})
"""Phases in which the inner steps run: the steps inside the step `fly`."""


@dataclass(frozen=True)
class FlightMoment:
    """A line of the log.

    Attributes:
        at_s: Time since the origin was set, shortly before the take-off.
        phase: Phase of the flight, for example `flying`.
        ahead_m: Position ahead of the origin.
        left_m: Position to the left of the origin.
        up_m: Height over the ground from which the drone took off for this flight.
        speed_m_s: Speed of the drone.
        utc_ns: Time by the clock of the drone's computer, nanoseconds since 1970 UTC; 0 if the line does not have it.
    """

    at_s: float
    phase: str
    ahead_m: float
    left_m: float
    up_m: float
    speed_m_s: float
    utc_ns: int = 0

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the origin."""
        return math.hypot(self.ahead_m, self.left_m)


def read(path: Path) -> tuple[FlightMoment, ...]:
    """Return the lines of a log in chronological order; an incomplete last line is omitted.

    Raises:
        EvidenceError: The log is missing, empty, has an invalid line, or its lines are not in order.
    """
    return motion_log.read(path, _parse_moment, "flight")


def _parse_moment(fields: Mapping[str, Any]) -> FlightMoment | None:
    """Convert the JSON object of a line, or return None for the origin and the end; raises one of `JSON_ERRORS`."""
    if "ended" in fields or "origin" in fields:
        return None
    at_s, speed_m_s, utc_ns = float(fields["at_s"]), float(fields["speed_m_s"]), int(fields.get("utc_ns", 0))
    ahead_m, left_m, up_m = (float(fields[name]) for name in ("ahead_m", "left_m", "up_m"))
    is_possible = (
        0 <= at_s <= LONGEST_S
        and math.hypot(ahead_m, left_m, up_m) <= LONGEST_M
        and 0 <= speed_m_s <= _MAX_SPEED_M_S
        and fields["phase"] in PHASES
        and 0 <= utc_ns < LAST_NS
    )
    if not is_possible:
        raise ValueError(fields)
    return FlightMoment(at_s, fields["phase"], ahead_m, left_m, up_m, speed_m_s, utc_ns)


def measure(log: Sequence[FlightMoment] | None) -> Measured:
    """Return the columns; all are missing if there is no log."""
    if not log:
        return Measured.all_missing(COLUMNS, "the drone wrote no log of its flight")
    heights_m = [moment.up_m for moment in log if moment.phase in _STEP_PHASES]
    speeds_m_s = [moment.speed_m_s for moment in log if moment.phase == ON_PATH]
    values: dict[str, Value | None] = {
        "fly_height_median_m": float(np.median(heights_m)) if heights_m else None,
        "fly_height_max_m": max(moment.up_m for moment in log),
        "fly_farthest_m": max(moment.distance_m for moment in log),
        "fly_speed_median_m_s": float(np.median(speeds_m_s)) if speeds_m_s else None,
        "fly_speed_max_m_s": max(moment.speed_m_s for moment in log),
        "fly_back_off_m": log[-1].distance_m if log[-1].phase == DESCENDING else None,
    }
    return Measured.from_optional(values, "the log has no line of this phase of the flight")

"""What a flight leaves behind: where the drone was by its autopilot, ten times a second, seen from where it stood."""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from typing import IO

from fieldkit.agent.flight_plan import Place


class FlightLog:
    """Writes a JSON object a line, as long as there is room: a drone does not come down for a full disk.

    Args:
        path: Where to; empty for nowhere.

    Attributes:
        phase: What the flight is about: `standing`, `climbing`, `up`, `flying`, `there`, `coming back` or
            `coming down`.
    """

    def __init__(self, path: str) -> None:
        self.phase = ""
        self._lines: IO[str] | None = None
        self._begin_m: Place = (0.0, 0.0, 0.0)
        self._cos, self._sin, self._began_s = 1.0, 0.0, 0.0
        if path:
            with suppress(OSError):  # the laptop sees that it is not there
                self._lines = open(path, "w", encoding="ascii")  # noqa: SIM115, PTH123 (for the flight)

    def begin(self, begin_m: Place, yaw_rad: float) -> None:
        """Take the place where it stands, and where its nose points, for what all lines are seen from."""
        self._begin_m, self._began_s = begin_m, time.monotonic()
        self._cos, self._sin = math.cos(yaw_rad), math.sin(yaw_rad)

    def note(self, place_m: Place | None, speed_m_s: float) -> None:
        """Write down where it is, if it says so, and how fast it moves; nothing before it stood."""
        if self._lines is None or place_m is None or not self.phase:
            return
        north_m, east_m, down_m = (now - then for now, then in zip(place_m, self._begin_m))
        said = {
            "utc_ns": time.time_ns(),
            "at_s": round(time.monotonic() - self._began_s, 3),
            "phase": self.phase,
            "ahead_m": round(north_m * self._cos + east_m * self._sin, 3),
            "left_m": round(north_m * self._sin - east_m * self._cos, 3),
            "up_m": round(-down_m, 3),
            "speed_m_s": round(speed_m_s, 3),
        }
        try:
            self._lines.write(json.dumps(said) + "\n")
            self._lines.flush()
        except OSError:
            self._lines = None

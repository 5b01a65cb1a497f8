"""The log of a flight: positions from the autopilot, ten times per second, relative to the flight's origin."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import asdict

from fieldkit.agent.autopilots.autopilot import AutopilotState
from fieldkit.agent.autopilots.mavlink_frames import LOCAL_POSITION_NED
from fieldkit.agent.flying.origin import FlightOrigin
from fieldkit.agent.numbered_lines import NumberedLines


class FlightLog:
    """Writes one JSON object per line. After a write error the log ends, but the flight continues.

    Args:
        path: The file; empty to write none.

    Attributes:
        phase: Phase of the flight, one of `flight_plan.PHASES`; empty before the first one.
    """

    def __init__(self, path: str) -> None:
        self.phase = ""
        self._lines: NumberedLines | None = None
        self._origin: FlightOrigin | None = None
        self._ground_m = self._start_s = 0.0
        if path:
            with suppress(OSError):  # the laptop detects the missing file
                self._lines = NumberedLines(open(path, "w", encoding="ascii"))  # noqa: SIM115, PTH123 (closed by `end`)

    def begin(self, origin: FlightOrigin, ground_m: float) -> None:
        """Set the origin of all positions, and write it.

        Args:
            origin: The origin.
            ground_m: Down coordinate of the ground in LOCAL_POSITION_NED.
        """
        self._origin, self._ground_m, self._start_s = origin, ground_m, time.monotonic()
        self._write({"utc_ns": time.time_ns(), "origin": asdict(origin)})

    def note(self, drone: AutopilotState) -> None:
        """Write position, speed and mode of the drone, and the rate at which it reports positions.

        Do nothing before `begin`, before the first phase, and if the autopilot has not reported its position
        recently.
        """
        if self._lines is None or self._origin is None or drone.position_m is None or not self.phase:
            return
        position_rate = drone.link.messages.get(LOCAL_POSITION_NED)
        ahead_m, left_m = self._origin.relative_m(drone.position_m)
        self._write(
            {
                "utc_ns": time.time_ns(),
                "at_s": round(time.monotonic() - self._start_s, 3),
                "phase": self.phase,
                "ahead_m": round(ahead_m, 3),
                "left_m": round(left_m, 3),
                "up_m": round(self._ground_m - drone.position_m[2], 3),
                "speed_m_s": round(drone.speed_m_s, 3),
                "mode": drone.mode_name,
                "rate_hz": round(position_rate.hz if position_rate else 0.0, 3),
            }
        )

    def _write(self, values: dict[str, object]) -> None:
        if self._lines is not None:
            try:
                self._lines.write(values)
            except OSError:
                self._lines = None

    def end(self, result: str) -> None:
        """Write the result of the flight, and a checksum; a log without them is not complete."""
        if self._lines is not None:
            with suppress(OSError):
                self._lines.end({"utc_ns": time.time_ns(), "ended": result})
        self._lines = None

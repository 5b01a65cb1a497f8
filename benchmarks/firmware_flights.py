"""Fly and record a drone with fieldkit's programs for the drone's computer, and print a table with a row per case.

    python -m benchmarks.firmware_flights --connection tcp:127.0.0.1:5760

Start a simulated autopilot before, for example ArduPilot's SITL (`sim_vehicle.py -v ArduCopter`) or PX4's SIH
(`make px4_sitl sihsim_quadx`), and pass its connection (SIH: `udpin:0.0.0.0:14540`). Never connect a real drone: it
takes off. The exit code is 1 if a case failed.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from fieldkit.agent.flying.flight_plan import FlightPlan
from fieldkit.remote import agent

HEIGHT_M: Final = 3.0
AHEAD_M: Final = 6.0
_RECORD_S: Final = 5.0
_BOOT_S: Final = 90.0
"""A real autopilot needs about 30 s for a good position estimate."""
_FLIGHT_S: Final = 240.0  # time limit of a flight
_RATES_US: Final = {"32": 100_000, "30": 100_000}
"""LOCAL_POSITION_NED and ATTITUDE at 10 Hz."""


@dataclass(frozen=True)
class Row:
    """Result of a case: its name, True if it passed, its measurements, and its duration."""

    case: str
    passed: bool
    observation: str
    duration_s: float


class CaseFailed(Exception):  # noqa: N818 (it is the result of a case)
    """A case failed; the text is the observation."""


class Bench:
    """Runs programs of the agent, fieldkit's Python program on robots, with one connection to an autopilot.

    Args:
        connection: Name of the connection to the autopilot, as in the key `mavlink.connection` of a profile.
        program: The agent.
        folder: Folder for orders and logs.
    """

    def __init__(self, connection: str, program: Path, folder: Path) -> None:
        self._connection = connection
        self._program = program
        self._folder = folder
        self._orders = 0

    def check(self) -> str:
        """Query the agent until the drone can be armed, for at most `_BOOT_S`."""
        needs = {
            "highest_m": HEIGHT_M,
            "farthest_m": AHEAD_M,
            "ceiling_m": 20.0,
            "least_charge": 0.2,
            "returns": False,
        }
        request, end_s = json.dumps({"connection": self._connection, "needs": needs}), time.monotonic() + _BOOT_S
        while True:
            completed = self._run("arming", request)
            lines = [json.loads(line) for line in completed.stdout.splitlines()]
            problems = [line["what"] for line in lines if line.get("grave")]
            if completed.returncode == 0 and lines and not problems:
                return f"{lines[-1]['autopilot']}, battery {lines[-1]['charge']}"
            if time.monotonic() > end_s:
                raise CaseFailed("; ".join(problems) or completed.stderr.strip())
            time.sleep(1.0)

    def record(self) -> str:
        """Record the telemetry, and count its frames."""
        log = self._folder / "flight.tlog"
        request = json.dumps({"connection": self._connection, "intervals_us": _RATES_US})
        with self._running("mavlink", request, str(log)) as process:
            time.sleep(_RECORD_S)
            process.terminate()
            process.communicate(timeout=30)
        counts = _messages(log)
        if process.returncode or not counts.get("LOCAL_POSITION_NED") or not counts.get("ATTITUDE"):
            raise CaseFailed(f"code {process.returncode}, {counts}, {self._last_log_line()}")
        return ", ".join(f"{name} {number}" for name, number in sorted(counts.items()))

    def out_and_back(self) -> str:
        """Fly out and back, and land; compare the log with the plan."""
        with self._flight(end="return") as process:
            self._write_order("climb")
            self._wait_for_phase(process, "up")
            self._write_order("go")
            self._wait_for_phase(process, "there")
            self._write_order("home")
            code = process.wait(_FLIGHT_S)
        high_m, far_m = self._extent_m()
        if code or abs(high_m - HEIGHT_M) > 0.7 or abs(far_m - AHEAD_M) > 0.7:
            raise CaseFailed(f"code {code}, {high_m:.1f} m high, {far_m:.1f} m far, {self._last_log_line()}")
        return f"{high_m:.1f} m high, {far_m:.1f} m far, landed"

    def lease_expires(self) -> str:
        """Let the last order expire while the drone is in the air; check that the drone lands."""
        with self._flight() as process:
            self._write_order("climb", lease_s=60.0)
            self._wait_for_phase(process, "up")
            self._write_order("stay", lease_s=1.0)
            start_s = time.monotonic()
            code = process.wait(_FLIGHT_S)
        if not code or "landed" not in self._log_text():
            raise CaseFailed(f"code {code}, {self._last_log_line()}")
        return f"landed {time.monotonic() - start_s:.0f} s after the last order"

    def terminate(self) -> str:
        """Terminate the program by SIGTERM while the drone is in the air; check that the drone lands."""
        with self._flight() as process:
            self._write_order("climb")
            self._wait_for_phase(process, "up")
            process.terminate()
            code = process.wait(_FLIGHT_S)
        if not code or "landed" not in self._log_text():
            raise CaseFailed(f"code {code}, {self._last_log_line()}")
        return "landed"

    @contextmanager
    def _flight(self, end: str = "land") -> "Iterator[subprocess.Popen[str]]":
        (self._folder / "orders").unlink(missing_ok=True)
        plan: dict[str, Any] = {
            "connection": self._connection,
            "orders": str(self._folder / "orders"),
            "abort": "land",
            "lease_s": 60.0,
            "end": end,
            "height_m": HEIGHT_M,
            "legs": [[AHEAD_M, 0.0, 0.0]],
            "ceiling_m": 20.0,
            "log": str(self._folder / "fly.jsonl"),
        }
        if "fence_m" in {field.name for field in fields(FlightPlan)}:
            plan["fence_m"] = 50.0
        with self._running("fly", json.dumps(plan)) as process:
            yield process

    @contextmanager
    def _running(self, *words: str) -> "Iterator[subprocess.Popen[str]]":
        with (self._folder / "log").open("w", encoding="utf-8") as stderr:
            argv = (sys.executable, str(self._program), *words)
            process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=stderr, text=True)
            try:
                yield process
            finally:
                process.kill()
                process.communicate()

    def _run(self, *words: str) -> "subprocess.CompletedProcess[str]":
        argv = (sys.executable, str(self._program), *words)
        return subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)

    def _write_order(self, what: str, lease_s: float = 120.0) -> None:
        """Write an order for the flying program. The order is valid for `lease_s` seconds (its lease)."""
        self._orders += 1
        new_file = self._folder / "orders.new"
        new_file.write_text(f"{self._orders} {what} {lease_s:g}\n", encoding="ascii")
        new_file.replace(self._folder / "orders")

    def _log_text(self) -> str:
        return (self._folder / "log").read_text(encoding="utf-8")

    def _last_log_line(self) -> str:
        return (self._log_text().splitlines() or ["it printed nothing"])[-1]

    def _wait_for_phase(self, process: "subprocess.Popen[str]", phase: str) -> None:
        """Wait until the program reports a phase of the flight."""
        end_s = time.monotonic() + _FLIGHT_S
        while phase not in (line.partition(" ")[2] for line in self._log_text().splitlines()):
            if process.poll() is not None or time.monotonic() > end_s:
                raise CaseFailed(f"not {phase}: {self._last_log_line()}")
            time.sleep(0.1)

    def _extent_m(self) -> tuple[float, float]:
        """Return the largest height and distance in the log of positions."""
        lines = (self._folder / "fly.jsonl").read_text(encoding="ascii").splitlines()
        positions = [position for line in lines if (position := _place(json.loads(line))) is not None]
        if not positions:
            raise CaseFailed("no position in its log")
        return max(up for _, _, up in positions), max(math.hypot(ahead, left) for ahead, left, _ in positions)


def _place(line: dict[str, Any]) -> tuple[float, float, float] | None:
    """Return the position in a line of the log, in metres ahead, left and up, or None for another line."""
    return (line["ahead_m"], line["left_m"], line["up_m"]) if "up_m" in line else None


def _messages(log: Path) -> dict[str, int]:
    """Return the number of messages of each type in a telemetry log."""
    from pymavlink import mavutil  # noqa: PLC0415 (takes 0.3 s)

    counts: dict[str, int] = {}
    reader = mavutil.mavlink_connection(str(log))
    while (message := reader.recv_match()) is not None:
        counts[message.get_type()] = counts.get(message.get_type(), 0) + 1
    return counts


def rows(connection: str) -> Iterator[Row]:
    """Yield the results of the cases as they finish."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "agent.pyz")
        program.write_bytes(agent.content())
        bench = Bench(connection, program, Path(folder))
        cases: dict[str, Callable[[], str]] = {
            "can be armed": bench.check,
            "telemetry is recorded": bench.record,
            "out and back": bench.out_and_back,
            "lease expires in the air": bench.lease_expires,
            "program is terminated in the air": bench.terminate,
        }
        for name, case in cases.items():
            start_s = time.monotonic()
            try:
                observation, passed = case(), True
            except (CaseFailed, subprocess.TimeoutExpired) as failure:
                observation, passed = str(failure), False
            yield Row(name, passed, observation, time.monotonic() - start_s)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases and print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--connection", required=True, help="as mavlink.connection of a profile")
    connection = parser.parse_args(arguments).connection
    sys.stdout.write("| case | result | observation | s |\n| --- | --- | --- | --- |\n")
    failed = False
    for row in rows(connection):
        failed = failed or not row.passed
        result = "passed" if row.passed else "FAILED"
        sys.stdout.write(f"| {row.case} | {result} | {row.observation} | {row.duration_s:.0f} |\n")
        sys.stdout.flush()
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

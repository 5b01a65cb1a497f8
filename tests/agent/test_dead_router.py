"""A router stops during a flight and does not restart: all programs of the flight stop in time, with an alarm."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

from fieldkit.agent.flying import landing
from fieldkit.agent.flying.flight_plan import CLIMB, FlightPlan
from fieldkit.agent.links import link_files
from fieldkit.core.deadline import Deadline
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from tests.helpers import drones
from tests.helpers.host import is_running
from tests.helpers.mavlink_router import MavlinkRouter
from tests.helpers.sshd import wait_until

NO_HEARTBEAT_S: Final = 5.0
"""The value of `landing.NO_HEARTBEAT_S` in this test. It is short, but longer than the 4 s before an alarm."""
PROGRAM: Final = f"""\
import sys
from fieldkit.agent.flying import landing
landing.NO_HEARTBEAT_S = {NO_HEARTBEAT_S}
from fieldkit.agent.__main__ import main
sys.exit(main(sys.argv[1:]))
"""
HEIGHT_M: Final = 0.6


@contextmanager
def running_program(plan: FlightPlan, log: Path) -> Iterator["subprocess.Popen[bytes]"]:
    with log.open("wb") as file:
        argv = (sys.executable, "-c", PROGRAM, "fly", json.dumps(asdict(plan)))
        process = subprocess.Popen(argv, stderr=file)
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def log_texts(log: Path) -> list[str]:
    return [line.partition(" ")[2] for line in log.read_text(encoding="utf-8").splitlines()]


def test_all_programs_stop_in_time_after_a_signal(tmp_path: Path) -> None:
    (tmp_path / "orders").write_text(f"1 {CLIMB} 600\n", encoding="ascii")
    with (
        drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot),
        MavlinkRouter(port) as router,
    ):
        connection = f"tcp:127.0.0.1:{router.tcp}"
        pilot_plan = FlightPlan(connection, str(tmp_path / "orders"), "land", 600.0, liveness=str(tmp_path / "life"))
        guard_plan = replace(pilot_plan, guards=True)
        pilot_plan = replace(pilot_plan, height_m=HEIGHT_M, ceiling_m=10.0, fence_m=20.0)
        logs = tmp_path / "guard.log", tmp_path / "pilot.log"
        with running_program(guard_plan, logs[0]) as guard:
            wait_until(lambda: "ready" in log_texts(logs[0]), Deadline.after(60))
            with running_program(pilot_plan, logs[1]) as pilot:
                wait_until(lambda: autopilot.vehicle.body.position_m[2] > 0.9 * HEIGHT_M, Deadline.after(60))
                wait_until(lambda: "up" in log_texts(logs[1]), Deadline.after(60))
                server = server_pid(connection)
                router.restart(3600.0)
                for process in (pilot, guard):
                    process.send_signal(signal.SIGINT)
                start_s = time.monotonic()
                assert [process.wait(60) for process in (pilot, guard)] == [landing.REFUSED] * 2
                duration_s = time.monotonic() - start_s
                wait_until(lambda: not is_running(server), Deadline.after(60))
        assert duration_s >= NO_HEARTBEAT_S
        assert autopilot.vehicle.is_armed, "the autopilot received no command"
    for log in logs:
        texts = log_texts(log)
        assert texts[-1] == f"error: no heartbeat from the autopilot for {NO_HEARTBEAT_S:g} s"
        first_alarm = next(text for text in texts if text.startswith("ALARM: THE DRONE MAY STILL BE IN THE AIR"))
        assert "LAST HEARTBEAT 4 S AGO" in first_alarm
        assert first_alarm.endswith(landing.MANUAL_ACTION)


def server_pid(connection: str) -> int:
    """Return the process id of the link server."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client, link_files.address(connection) as address:
        client.connect(address)
        return link_files.peer_credentials(client)[0]

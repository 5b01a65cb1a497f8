"""A drone lands if its pilot can no longer write, or receives no answers."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from fieldkit.agent.autopilots.mavlink_frames import LOCAL_POSITION_NED, parse_frame
from fieldkit.agent.flying import flight, landing, liveness, loop
from fieldkit.agent.flying.flight_plan import CLIMB, GO, HOME, FlightPlan
from fieldkit.core.deadline import Deadline
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.modes import Mode
from tests.helpers import drones
from tests.helpers.sshd import wait_until

HEIGHT_M = 0.6
LIMITS = ("GAP_S", "HEARTBEAT_S", "COMMAND_TIMEOUT_S", "_FLIGHT_HEARTBEAT_TIMEOUT_S", "_POSITION_TIMEOUT_S")
"""Time limits of a flight, each of which could end it on a busy machine."""
LONG_LIMIT_S = 60.0
SLOW_MACHINE = f"""\
import sys
from fieldkit.agent.flying import landing
from fieldkit.agent.flying import guard, liveness, loop
landing._MODE_WAIT_S = guard.GAP_S = liveness.SILENCE_TIMEOUT_S = {LONG_LIMIT_S}
for name in {LIMITS}:
    setattr(loop, name, {LONG_LIMIT_S})
from fieldkit.agent.__main__ import main
sys.exit(main(sys.argv[1:]))
"""
"""The program with time limits that a busy machine does not exceed."""


@pytest.fixture
def _long_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set limits that a busy machine does not exceed. A test shortens the limit under test."""
    for name in LIMITS:
        monkeypatch.setattr(loop, name, LONG_LIMIT_S)


def plan(folder: Path, port: int) -> FlightPlan:
    connection, orders = f"udpout:127.0.0.1:{port}", str(folder / "orders")
    return FlightPlan(connection, orders, "land", 60.0, height_m=HEIGHT_M, ceiling_m=10.0, fence_m=20.0)


def order(folder: Path, number: int, command: str) -> None:
    new_file = folder / "orders.new"
    new_file.write_text(f"{number} {command} 60\n", encoding="ascii")
    new_file.replace(folder / "orders")


def wait_until_up(autopilot: Autopilot) -> None:
    wait_until(lambda: autopilot.vehicle.body.position_m[2] > 0.9 * HEIGHT_M, Deadline.after(60))


def wait_until_down(autopilot: Autopilot) -> None:
    wait_until(lambda: not autopilot.vehicle.is_armed, Deadline.after(60))
    assert autopilot.vehicle.body.on_ground


@contextmanager
def agent(flight_plan: FlightPlan) -> Iterator["subprocess.Popen[bytes]"]:
    argv = (sys.executable, "-c", SLOW_MACHINE, "fly", json.dumps(asdict(flight_plan)))
    process = subprocess.Popen(argv, stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def test_pilot_without_disk_space_for_its_output_lands(tmp_path: Path) -> None:
    """As on a full disk: further output is lost, but the drone lands."""
    order(tmp_path, 1, CLIMB)
    with drones.autopilot_at_udp() as (port, autopilot), agent(plan(tmp_path, port)) as process:
        wait_until_up(autopilot)
        assert process.stderr is not None
        process.stderr.close()
        order(tmp_path, 2, GO)
        order(tmp_path, 3, HOME)
        wait_until_down(autopilot)
        assert process.wait(60) == 0


def test_log_on_a_full_disk_does_not_end_a_flight(tmp_path: Path) -> None:
    """The log of positions ends, but the flight continues."""
    order(tmp_path, 1, CLIMB)
    with (
        drones.autopilot_at_udp() as (port, autopilot),
        agent(replace(plan(tmp_path, port), log="/dev/full")) as process,
    ):
        wait_until_up(autopilot)
        order(tmp_path, 2, GO)
        order(tmp_path, 3, HOME)
        wait_until_down(autopilot)
        assert process.wait(60) == 0


@pytest.mark.usefixtures("_long_limits")
@pytest.mark.parametrize(
    ("lost_message", "reason"),
    [
        (None, "no heartbeat from the autopilot for 2 s"),
        (LOCAL_POSITION_NED, "it has not reported its position for 2 s"),
    ],
    ids=["everything", "positions"],
)
def test_autopilot_without_reports_is_commanded_to_land(
    lost_message: int | None,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The autopilot may still receive commands although its messages are lost."""
    monkeypatch.setattr(loop, "_POSITION_TIMEOUT_S" if lost_message else "_FLIGHT_HEARTBEAT_TIMEOUT_S", 2.0)
    is_silent, exit_codes = threading.Event(), list[int]()
    order(tmp_path, 1, CLIMB)

    def damage(frame: bytes) -> list[bytes]:
        return [] if is_silent.is_set() and lost_message in {None, parse_frame(frame).kind} else [frame]

    with drones.autopilot_at_udp(damage) as (port, autopilot):
        flight_plan, finished = plan(tmp_path, port), threading.Event()
        pilot = threading.Thread(target=lambda: exit_codes.append(flight.fly(flight_plan, finished)))
        pilot.start()
        try:
            wait_until_up(autopilot)
            is_silent.set()
            wait_until_down(autopilot)
            is_silent.clear()
            pilot.join(60)
        finally:
            finished.set()
            pilot.join(60)
    assert exit_codes == [landing.REFUSED]
    assert reason in capfd.readouterr().err


@pytest.mark.usefixtures("_long_limits")
def test_silent_autopilot_ends_the_flight_with_an_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """As if its router had stopped: the alarm is logged first, and the program exits some time later."""
    monkeypatch.setattr(loop, "_FLIGHT_HEARTBEAT_TIMEOUT_S", 5.0)
    monkeypatch.setattr(landing, "NO_HEARTBEAT_S", 1.0)
    is_silent, finished, exit_codes = threading.Event(), threading.Event(), list[int]()
    order(tmp_path, 1, CLIMB)
    with drones.autopilot_at_udp(lambda frame: [] if is_silent.is_set() else [frame]) as (port, autopilot):
        flight_plan = plan(tmp_path, port)
        pilot = threading.Thread(target=lambda: exit_codes.append(flight.fly(flight_plan, finished)))
        pilot.start()
        try:
            wait_until_up(autopilot)
            is_silent.set()
            pilot.join(60)
        finally:
            finished.set()
            pilot.join(60)
    assert exit_codes == [landing.REFUSED]
    lines = capfd.readouterr().err.splitlines()
    texts = [line.partition(" ")[2] for line in lines]
    alarms = [number for number, text in enumerate(texts) if text.startswith("ALARM: THE DRONE MAY STILL BE")]
    assert texts[alarms[0] - 1] == "land: no heartbeat from the autopilot for 5 s"
    assert all(text.endswith(landing.MANUAL_ACTION) for text in (texts[number] for number in alarms))
    assert texts[-1] == "error: no heartbeat from the autopilot for 1 s"


def test_drone_with_stopped_motors_is_released(tmp_path: Path) -> None:
    """As after a crash or by a kill switch. An ArduCopter does not change its mode."""
    order(tmp_path, 1, CLIMB)
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot), agent(plan(tmp_path, port)) as process:
        wait_until_up(autopilot)
        autopilot.vehicle.disarm(force=True)
        assert process.wait(60) == landing.TAKEN_OVER
        assert process.stderr is not None
        assert b"its motors have stopped" in process.stderr.read()


def test_guard_does_not_command_drone_taken_over_from_suspended_pilot(tmp_path: Path) -> None:
    """The guard observes the suspended pilot before the heartbeat that reports the new mode."""
    order(tmp_path, 1, CLIMB)
    is_silent, life = threading.Event(), tmp_path / "life"

    def guard_iterations() -> int:
        return liveness.entries(life.read_bytes())[liveness.GUARD].iterations

    with drones.autopilot_at_udp(lambda frame: [] if is_silent.is_set() else [frame], ARDUCOPTER) as (
        port,
        autopilot,
    ):
        pilot_plan = replace(plan(tmp_path, port), liveness=str(life))
        with agent(replace(pilot_plan, guards=True)) as guard:
            # The file is created first, and then allocated.
            wait_until(lambda: life.exists() and life.stat().st_size == liveness.SIZE, Deadline.after(60))
            wait_until(lambda: guard_iterations() > 0, Deadline.after(60))
            with agent(pilot_plan) as pilot:
                wait_until_up(autopilot)
                is_silent.set()
                autopilot.vehicle.change_mode(Mode.LOITER)
                min_iterations = guard_iterations() + 2
                wait_until(lambda: guard_iterations() >= min_iterations, Deadline.after(60))
                pilot.send_signal(signal.SIGSTOP)
                assert pilot.wait(60) == -signal.SIGKILL
                is_silent.clear()
                assert guard.wait(60) == landing.TAKEN_OVER
        assert autopilot.vehicle.mode is Mode.LOITER
        assert not autopilot.vehicle.body.on_ground

"""The rescue program kills the pilot and the guard, and lands a drone that their flight still controls."""

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from fieldkit.agent.flying import flight, landing, liveness, rescue
from fieldkit.agent.flying.flight_plan import FlightPlan
from fieldkit.core.deadline import Deadline
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.flight import SetPoint
from sim_backends.emulated.autopilot.modes import Mode
from sim_backends.emulated.autopilot.px4 import PX4
from tests.helpers import drones
from tests.helpers.sshd import wait_until

HEIGHT_M = 1.0
UPDATE_LOOP = """\
import sys, time
from fieldkit.agent.flying.liveness import FLYING, IDLE, LivenessFile
file = LivenessFile(sys.argv[1], int(sys.argv[2]))
while True:
    file.update(IDLE if int(sys.argv[2]) else FLYING)
    time.sleep(0.02)
"""


def plan(folder: Path, port: int) -> FlightPlan:
    connection = f"udpout:127.0.0.1:{port}"
    return FlightPlan(connection, "", "land", 0.0, rescues=True, liveness=str(folder / "liveness"))


@contextmanager
def suspended_programs(folder: Path) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Run a pilot and a guard, and suspend both after their start."""
    path = folder / "liveness"
    with ExitStack() as stack:
        processes = [
            subprocess.Popen((sys.executable, "-c", UPDATE_LOOP, str(path), str(role)))
            for role in (liveness.PILOT, liveness.GUARD)
        ]
        for process in processes:
            stack.callback(process.wait, 60)
            stack.callback(process.kill)
        wait_until(lambda: have_started(path), Deadline.after(60))
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        yield processes


def have_started(path: Path) -> bool:
    """Return True if both programs have updated the file."""
    life_entries = entries(path) if path.exists() else ()
    return bool(life_entries) and all(entry.iterations for entry in life_entries)


def entries(path: Path) -> tuple[liveness.LifeEntry, ...]:
    content = path.read_bytes()
    return liveness.entries(content) if len(content) == liveness.SIZE else ()


def fly_up(autopilot: Autopilot, firmware: Firmware) -> None:
    """Let the drone hover in guided mode. Afterwards a PX4 receives no more set-points."""
    vehicle = autopilot.vehicle
    wait_until(lambda: not vehicle.arming_errors, Deadline.after(60))
    if firmware is PX4:
        vehicle.accept_set_point(SetPoint((0.0, 0.0, HEIGHT_M), is_position=True))
    vehicle.change_mode(Mode.OFFBOARD)
    vehicle.arm()
    if firmware is PX4:
        wait_until(lambda: send_set_point(autopilot) > 0.8 * HEIGHT_M, Deadline.after(60))
    else:
        vehicle.take_off(HEIGHT_M)
        wait_until(lambda: vehicle.mode is Mode.OFFBOARD and height_m(autopilot) > 0.8 * HEIGHT_M, Deadline.after(60))


def send_set_point(autopilot: Autopilot) -> float:
    autopilot.vehicle.accept_set_point(SetPoint((0.0, 0.0, HEIGHT_M), is_position=True))
    return height_m(autopilot)


def height_m(autopilot: Autopilot) -> float:
    return autopilot.vehicle.body.position_m[2]


@pytest.mark.parametrize("firmware", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_pilot_and_guard_are_killed_before_the_drone_lands(tmp_path: Path, firmware: Firmware) -> None:
    with drones.autopilot_at_udp(firmware=firmware) as (port, autopilot), suspended_programs(tmp_path) as processes:
        fly_up(autopilot, firmware)
        if firmware is PX4:
            wait_until(lambda: autopilot.vehicle.mode is Mode.LOITER, Deadline.after(60))
        assert flight.fly(plan(tmp_path, port), threading.Event()) == 0
        assert [process.wait(60) for process in processes] == [-signal.SIGKILL] * 2
        assert not autopilot.vehicle.is_armed
        assert autopilot.vehicle.body.on_ground


@pytest.mark.parametrize("firmware", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_drone_that_a_person_has_taken_over_is_not_commanded(
    tmp_path: Path, firmware: Firmware, capfd: pytest.CaptureFixture[str]
) -> None:
    with drones.autopilot_at_udp(firmware=firmware) as (port, autopilot), suspended_programs(tmp_path):
        fly_up(autopilot, firmware)
        if firmware is PX4:
            wait_until(lambda: autopilot.vehicle.mode is Mode.LOITER, Deadline.after(60))
        autopilot.vehicle.change_mode(Mode.LOITER if firmware is PX4 else Mode.POSHOLD)
        assert flight.fly(plan(tmp_path, port), threading.Event()) == landing.TAKEN_OVER
        assert autopilot.vehicle.is_armed
        assert height_m(autopilot) > 0.5 * HEIGHT_M
    assert "nothing more is sent" in capfd.readouterr().err


def test_stop_signal_does_not_stop_the_rescue(tmp_path: Path) -> None:
    finished = threading.Event()
    finished.set()
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot), suspended_programs(tmp_path):
        fly_up(autopilot, ARDUCOPTER)
        assert flight.fly(plan(tmp_path, port), finished) == 0
        assert autopilot.vehicle.body.on_ground


def test_missing_heartbeat_ends_with_an_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rescue, "NO_HEARTBEAT_S", 1.0)
    (tmp_path / "liveness").touch()
    with drones.autopilot_at_udp(damage=lambda _: []) as (port, _):
        assert flight.fly(plan(tmp_path, port), threading.Event()) == landing.REFUSED
    errors = capfd.readouterr().err
    assert "ALARM: THE DRONE MAY STILL BE IN THE AIR" in errors
    assert landing.MANUAL_ACTION in errors
    assert "no heartbeat from the autopilot" in errors


def test_connection_that_cannot_be_opened_ends_with_an_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rescue, "NO_HEARTBEAT_S", 1.0)
    (tmp_path / "liveness").touch()
    unreachable_plan = FlightPlan(
        "tcp:127.0.0.1:9", "", "land", 0.0, rescues=True, liveness=str(tmp_path / "liveness")
    )
    assert flight.fly(unreachable_plan, threading.Event()) == landing.REFUSED
    assert landing.MANUAL_ACTION in capfd.readouterr().err

"""Flights that end before their nested steps, with the real agent and an emulated autopilot on this machine."""

import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.motion.abort_actions import ON_ABORT, AbortActions, OnAbort
from fieldkit.motion.profile_sections import mavlink_of
from fieldkit.motion.steps.fly import FlyStep
from fieldkit.remote import evidence, jobs
from fieldkit.remote.shell import Completed
from fieldkit.steps.scene import Scene
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.modes import Mode
from sim_backends.emulated.autopilot.px4 import PX4
from tests.agent.test_link_server import servers
from tests.helpers import drones
from tests.helpers.casts import DUCKIEDRONE
from tests.helpers.host import descendants, process_file, wait_for_end
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.mavlink_router import MavlinkRouter
from tests.helpers.nightly import mark_nightly
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import LocalShell

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "tcp-01-1")
FLIGHT = "robot: receiver, height: 60cm, path: [{away: 2m}], speed: 3m/s"
DETECTION_LIMIT_S = 5.0
"""Maximum time until the loss is detected on a busy machine; a quiet machine needs less than 1 s."""
NEAR_M = 0.6
"""Maximum distance to the take-off point after the return; the drone had flown more than twice as far."""


class Shell(LocalShell):
    """A robot with a link that can be interrupted."""

    is_interrupted = False

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        if self.is_interrupted:
            raise LinkError("is out of range", where=self.robot, remedy="wait")
        return super().run(argv, deadline=deadline, stdin=stdin, check=check)


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    test_shell = Shell(tmp_path)
    jobs.install(test_shell, Deadline.after(30))
    evidence.begin(test_shell, FOLDER, "receiver", "lo")
    yield test_shell
    deadline = Deadline.after(120)
    while running := jobs.list_running(test_shell, Deadline.after(60)):
        assert not deadline.expired, (running, log(test_shell))
        time.sleep(0.1)


def fly(
    shell: Shell,
    url: int | str,
    wait_duration: str,
    on_wait: Callable[[], object],
    abort: OnAbort = OnAbort.LAND,
    *,
    lease: str = "30s",
) -> None:
    """Fly a drone at a UDP port or a connection. `on_wait` is called when a nested step starts."""
    connection = url if isinstance(url, str) else f"udpout:127.0.0.1:{url}"
    mavlink = mavlink_of(DUCKIEDRONE)
    assert mavlink is not None
    update = {
        "ros": None,
        "tools": DUCKIEDRONE.tools.model_copy(update={"python": sys.executable}),
        "mavlink": mavlink.model_copy(update={"connection": connection}),
    }
    profile = DUCKIEDRONE.model_copy(update=update)
    robot = Robot(name="drone", address="127.0.0.1", profile=profile, abilities=frozenset({"mavlink"}))
    scene = Scene(
        Protocol.TCP, {Role.RECEIVER: robot}, FOLDER, sections={ON_ABORT: AbortActions({Role.RECEIVER: abort})}
    )
    wait = f"{{wait: {{duration: {wait_duration}}}}}"
    step = f"{{{FLIGHT}, lease: {lease}, during: [{wait}, {wait}]}}"

    def announce(name: str, _: float | None) -> None:
        if name == "wait":
            on_wait()

    schema.validate(schema.parse(step, source="x.yaml"), FlyStep).run(
        scene, IdleTestbed({Role.RECEIVER: shell}), announce
    )


def log(shell: Shell) -> str:
    return (shell.home / FOLDER / "fly.log").read_text(encoding="utf-8")


@pytest.mark.nightly  # CI tests the takeover of an ArduCopter
def test_takeover_by_a_person_aborts_the_nested_steps(shell: Shell) -> None:
    with drones.autopilot_at_udp() as (port, autopilot):
        with pytest.raises(
            RobotError, match="here: its flight ended early: a person or another program flies it"
        ) as error_info:
            fly(shell, port, "60min", lambda: autopilot.vehicle.change_mode(Mode.LAND))
        assert "the wait was interrupted" in str(error_info.value.__cause__)
        assert "landed" not in log(shell), "the pilot released the drone"


def agent_of(shell: Shell, job: str) -> int:
    """Return the process id of the agent of a job."""
    leader = int((shell.home / FOLDER / f".jobs/{job}/pid").read_text(encoding="ascii").split()[0])
    (pid,) = (pid for pid in descendants(leader) if process_file(pid, "comm").startswith(b"python"))
    return pid


def log_lines(shell: Shell, job: str) -> list[tuple[float, str]]:
    """Return the lines of a job's log with their times, in seconds since 1970."""
    lines = (shell.home / FOLDER / f"{job}.log").read_text(encoding="utf-8").splitlines()
    return [(float(line.partition(" ")[0]), line.partition(" ")[2]) for line in lines]


@pytest.mark.quiet
@pytest.mark.parametrize(
    ("target_program", "watcher", "signal_number"),
    [
        ("fly", "guard", signal.SIGSTOP),
        ("guard", "fly", signal.SIGKILL),
        pytest.param("fly", "guard", signal.SIGKILL, marks=pytest.mark.nightly),
        pytest.param("guard", "fly", signal.SIGSTOP, marks=pytest.mark.nightly),
    ],
)
def test_pilot_and_guard_detect_within_a_second_that_the_other_does_not_run(
    shell: Shell, target_program: str, watcher: str, signal_number: signal.Signals
) -> None:
    at_s: list[float] = []

    def send_signal() -> None:
        at_s.append(time.time())
        os.kill(agent_of(shell, target_program), signal_number)

    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot):
        with pytest.raises(RobotError):
            fly(shell, port, "60min", send_signal)
        wait_until(lambda: not autopilot.vehicle.is_armed, Deadline.after(60))
        evidence.end_jobs(shell, FOLDER)
    (detected_s,) = (detected_s for detected_s, text in log_lines(shell, watcher) if text.startswith("land: the "))
    assert detected_s - at_s[0] < 1.0


@pytest.mark.parametrize("signal_number", mark_nightly([signal.SIGSTOP, signal.SIGKILL]))
def test_flight_continues_without_its_link_server(shell: Shell, signal_number: signal.Signals) -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot):
        connection, killed_servers = f"udpout:127.0.0.1:{port}", list[int]()

        def send_signal() -> None:
            if not killed_servers:
                killed_servers.extend(servers(connection))
                os.kill(killed_servers[0], signal_number)
                wait_until(lambda: bool({*servers(connection)} - {*killed_servers}), Deadline.after(60))
                assert autopilot.vehicle.is_armed, "the server was replaced in flight"

        fly(shell, port, "5s", send_signal)
        assert len(killed_servers) == 1
        assert autopilot.vehicle.body.on_ground
        assert not autopilot.vehicle.is_armed
    wait_for_end(set(killed_servers), within_s=30.0)
    assert [text for _, text in log_lines(shell, "fly")][-1] == "landed"


def silent_lines(shell: Shell) -> int:
    """Return the number of log lines, ten per second, that report no position in the last second of flight."""
    lines = (shell.home / FOLDER / "fly.jsonl").read_text(encoding="ascii").splitlines()
    moments = [moment for moment in map(json.loads, lines) if moment.get("phase") in {"flying", "there"}]
    assert moments
    return sum(moment["rate_hz"] == 0 for moment in moments)


def test_flight_continues_after_restart_of_its_router(shell: Shell) -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot), MavlinkRouter(port) as router:
        restarts: list[float] = []

        def restart() -> None:
            if not restarts:
                restarts.append(2.0)
                router.restart(restarts[0])

        fly(shell, f"tcp:127.0.0.1:{router.tcp}", "5s", restart)
        assert autopilot.vehicle.body.on_ground
        assert not autopilot.vehicle.is_armed
        assert restarts
        assert router.accepted == 2, "the link server connected before and after the restart"
    assert silent_lines(shell) >= 3, "no positions arrived during the interruption"
    assert [text for _, text in log_lines(shell, "fly")][-1] == "landed"


def test_flight_continues_after_serial_device_was_missing_for_two_seconds(shell: Shell, tmp_path: Path) -> None:
    with drones.autopilot_at_usb(tmp_path / "ttyUSB0") as (usb, autopilot):
        reconnection = threading.Timer(2.0, usb.plug_in)

        def pull_out() -> None:
            if not reconnection.ident:
                usb.pull_out()
                reconnection.start()
                assert autopilot.vehicle.is_armed

        fly(shell, f"{usb.path}:115200", "5s", pull_out)
        reconnection.join()
        assert autopilot.vehicle.body.on_ground
        assert not autopilot.vehicle.is_armed
    assert silent_lines(shell) >= 3, "no positions arrived during the interruption"
    assert [text for _, text in log_lines(shell, "fly")][-1] == "landed"


@pytest.mark.parametrize(
    ("firmware", "signal_number"),
    [
        (PX4, signal.SIGSTOP),
        pytest.param(ARDUCOPTER, signal.SIGKILL, marks=pytest.mark.nightly),
        pytest.param(PX4, signal.SIGKILL, marks=pytest.mark.nightly),
        pytest.param(ARDUCOPTER, signal.SIGSTOP, marks=pytest.mark.nightly),
    ],
)
def test_guard_lands_drone_whose_pilot_does_not_run(
    shell: Shell, signal_number: signal.Signals, firmware: Firmware
) -> None:
    """The guard first kills a suspended pilot, which could otherwise control the drone again later."""
    killed_pilots: list[tuple[int, float]] = []

    def send_signal() -> None:
        pid = agent_of(shell, "fly")
        os.kill(pid, signal_number)
        killed_pilots.append((pid, time.time()))

    with drones.autopilot_at_udp(firmware=firmware) as (port, autopilot):
        with pytest.raises(RobotError, match="ended with exit code 137"):
            fly(shell, port, "60min", send_signal)
        wait_until(lambda: not autopilot.vehicle.is_armed, Deadline.after(60))
        assert autopilot.vehicle.body.on_ground
        wait_until(lambda: any(text == "landed" for _, text in log_lines(shell, "guard")), Deadline.after(60))
    ((pid, at_s),) = killed_pilots
    wait_for_end({pid}, within_s=30.0)
    (detected_s,) = (
        detected_s for detected_s, text in log_lines(shell, "guard") if text.startswith("land: the pilot ")
    )
    assert detected_s - at_s < DETECTION_LIMIT_S


@pytest.mark.parametrize("signal_number", mark_nightly([signal.SIGSTOP, signal.SIGKILL]))
def test_pilot_lands_drone_whose_guard_does_not_run(shell: Shell, signal_number: signal.Signals) -> None:
    guards: list[int] = []

    def send_signal() -> None:
        guards.append(agent_of(shell, "guard"))
        os.kill(guards[0], signal_number)

    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot):
        with pytest.raises(RobotError, match="its flight ended early: the guard "):
            fly(shell, port, "60min", send_signal)
        wait_until(lambda: not autopilot.vehicle.is_armed, Deadline.after(60))
        wait_until(lambda: "landed" in log(shell), Deadline.after(60))
        if signal_number == signal.SIGSTOP:
            os.kill(guards[0], signal.SIGCONT)
    evidence.end_jobs(shell, FOLDER)


def test_no_program_commands_a_drone_after_takeover_by_a_person(shell: Shell) -> None:
    """A person switches an ArduCopter to LOITER by remote control. Then the job is stopped, as by Ctrl-C."""
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot):
        with pytest.raises(RobotError, match=r"a person or another program flies it \(mode LOITER") as error_info:
            fly(shell, port, "60min", lambda: autopilot.vehicle.change_mode(Mode.LOITER))
        assert "MAY STILL BE IN THE AIR" in str(error_info.value)
        assert "the wait was interrupted" in str(error_info.value.__cause__)
        assert "MODE LOITER" in log(shell)
        evidence.end_jobs(shell, FOLDER)
        wait_until(lambda: jobs.list_running(shell, Deadline.after(30)) == (), Deadline.after(60))
        assert autopilot.vehicle.mode is Mode.LOITER
        assert autopilot.vehicle.is_armed
        assert not autopilot.vehicle.body.on_ground


def test_arducopter_returns_after_its_lease_has_expired(shell: Shell) -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot):
        for name, centimetres in (("RTL_ALT", 100.0), ("WPNAV_RADIUS", 10.0)):
            autopilot._parameters.set(name, centimetres)
        vehicle = autopilot.vehicle

        def interrupt_link() -> None:
            wait_until(lambda: math.hypot(*vehicle.body.position_m[:2]) > 1.5, Deadline.after(60))
            shell.is_interrupted = True

        with pytest.raises(LinkError, match="out of range"):
            fly(shell, port, "1ms", interrupt_link, OnAbort.RETURN, lease="3s")
        wait_until(lambda: not vehicle.is_armed, Deadline.after(60))
        assert math.hypot(*vehicle.body.position_m[:2]) < NEAR_M, "the drone is at the take-off point"
        shell.is_interrupted = False
        wait_until(lambda: "landed" in log(shell), Deadline.after(60))
        assert "return: the order was not renewed in time" in log(shell)


def test_stop_of_all_jobs_lets_the_pilot_land(shell: Shell) -> None:
    """The landing takes longer than the grace period of other jobs."""
    with drones.autopilot_at_udp() as (port, autopilot):
        autopilot._parameters.set("MPC_LAND_SPEED", 0.1)
        with suppress(RobotError):
            fly(shell, port, "60min", lambda: evidence.end_jobs(shell, FOLDER))
        wait_until(lambda: "landed" in log(shell), Deadline.after(60))
        assert "land: the job was cancelled" in log(shell)
        assert not autopilot.vehicle.is_armed

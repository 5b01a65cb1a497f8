"""Drones in trials: one flies away in MuJoCo during a transfer, and drones land if fieldkit is stopped or killed."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Vector
from fieldkit.measure.evidence import track
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.host import descendants, wait_for_end
from tests.helpers.paths import ROOT
from tests.helpers.runs import finish, only_trial, rows, run_here, start, wait_for_line
from tests.helpers.sshd import wait_until
from tests.helpers.texts import procedure, site

pytestmark = pytest.mark.emulated

# The drone is in range at its start, and out of range 20 m farther. With the default of `late_bound`, 0.1 s, a repeat
# on a busy machine may be void: a lateness of 0.07 s was measured at a load of 26.
SITE = site(
    {"turtlebot-1": "turtlebot3_burger", "duckiedrone-1": "duckiedrone"},
    emulated="ros: builtin, radio: {fading: false, shadowing_db: 0.0, noise_floor_dbm: -59, mode: n0}, "
    "late_bound: 2s, physics: mujoco, sync: {name: sliding_window, window: 4ms}",
)
PROCEDURE = procedure(
    "flyaway",
    """\
- fly:
    robot: receiver
    height: 1m
    path: [{away: 20m}]
    speed: 3m/s
    then: land
    lease: 30s
    during: DURING
""",
    more="on_abort: {receiver: land}\n",
)
TRANSFER = """
        - capture:
            robots: [sender, receiver]
            port: 1234
            during:
              - send: {from: sender, to: receiver, size: 1MB, port: 1234}
              - ping: {from: sender, to: receiver, count: 40, interval: 100ms, payload_bytes: {tcp: 100, udp: 100}}
"""


def lab(folder: Path, during: str) -> Path:
    (folder / "procedures").mkdir()
    (folder / "procedures/flyaway.yaml").write_text(PROCEDURE.replace("DURING", during), encoding="utf-8")
    return folder


def test_the_row_of_a_repeat_describes_the_flight_of_the_drone(tmp_path: Path) -> None:
    (lab(tmp_path, TRANSFER) / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    run = run_here(tmp_path, "trial", "flyaway", "3m")
    assert run.code == 0, run.err
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["status"] == "valid"
    assert float(row["file_loss"]) == 0.0
    assert 3.0 < float(row["transfer_distance_start_m"]) < 4.0
    assert float(row["transfer_distance_max_m"]) > float(row["transfer_distance_start_m"]) + 0.5
    assert float(row["rtt_distance_max_m"]) > 8.0
    assert float(row["rtt_loss"]) > 0.1
    points = track.read(trial / "repeats/tcp-01/track.csv")
    flown_m = [point.position_m for point in points if point.role is Role.RECEIVER and point.position_m is not None]
    ground_m = flown_m[0][2]
    assert max(up_m for _, _, up_m in flown_m) == pytest.approx(ground_m + 1.0, abs=0.4)
    assert flown_m[-1][2] == pytest.approx(ground_m, abs=0.002), "it landed"
    assert row["backend"].startswith("emulated (physics mujoco, network builtin, sync sliding_window, window 0.004 s")
    assert 0 < float(row["delay_policy_s"]) < 0.0045
    assert 0.0 < float(row["cosim_late_p99_s"]) <= float(row["cosim_late_max_s"]) < 2.0
    assert flown_m[-1][0] - flown_m[0][0] > 8.0, "the drone has flown from its start"
    log = (trial / "repeats/tcp-01/fly.log").read_text(encoding="utf-8").split("\n")
    log_texts = [line.partition(" ")[2] for line in log if line]
    phases = "ready", "standing", "climbing", "up", "flying", "coming down", "landed"
    assert [text for text in log_texts if text in phases] == list(phases)
    assert float(row["fly_height_median_m"]) == pytest.approx(1.0, abs=0.3)
    assert float(row["fly_farthest_m"]) == pytest.approx(flown_m[-1][0] - flown_m[0][0], abs=0.5)
    assert 1.0 < float(row["fly_speed_median_m_s"]) < 4.0
    assert "flight height, median" in run.out
    assert "flew " in run.out


# One drone of each family of autopilots. fieldkit uses both like real robots.
DRONES = site({"copter-1": "copter", "duckiedrone-1": "duckiedrone"}, emulated="ros: builtin")
PROCEDURE_WITH_LEASE = procedure(
    "givenup",
    """\
- fly:
    robot: ROLE
    height: 60cm
    path: [{away: 2m}]
    speed: 3m/s
    lease: LEASE
    during: [{wait: {duration: 90s}}]
""",
    more="on_abort: {ROLE: HOW}\n",
)
SET_PARAMETER = """\
from pymavlink import mavutil
drone = mavutil.mavlink_connection("udpout:127.0.0.1:14550", source_system=250)
while not drone.messages.get("PARAM_VALUE") or drone.messages["PARAM_VALUE"].param_value != {value}:
    drone.mav.heartbeat_send(6, 8, 0, 0, 0)
    drone.mav.param_set_send(0, 1, b"{name}", {value}, 9)
    drone.recv_match(type="PARAM_VALUE", blocking=True, timeout=0.5)
"""
STATIONARY_DRONE = """\
from pymavlink import mavutil
drone, beat = mavutil.mavlink_connection("udpout:127.0.0.1:14550", source_system=251), None
while beat is None or beat.base_mode & 128:
    drone.mav.heartbeat_send(6, 8, 0, 0, 0)
    beat = drone.recv_match(type="HEARTBEAT", blocking=True, timeout=0.5) or beat
"""
SLOW_LANDING = "MPC_LAND_SPEED", 0.125
"""At the default, 0.7 m/s, the drone lands before a busy machine has reported that it is coming down."""
NEAR_M = 0.6
"""Maximum distance from home after the return; the drone flies three times as far."""
PRINT_NEWEST_LOG = 'cat "$(ls -t .fieldkit/*/*/fly.log | head -n 1)"'


START_M: dict[Role, Vector] = {}
"""Initial positions of the drones of the fixture `field_robots`."""


@pytest.fixture(scope="module")
def field_robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FieldRobots]:
    folder = tmp_path_factory.mktemp("drones")
    (folder / "robots").mkdir()
    profile = (
        (ROOT / "robots/duckiedrone.yaml").read_text(encoding="utf-8").replace("name: duckiedrone", "name: copter")
    )
    profile = profile.replace("port: 14550", "port: 14550\n  autopilot: ardupilot")
    (folder / "robots/copter.yaml").write_text(profile, encoding="utf-8")
    (folder / "drones.yaml").write_text(DRONES, encoding="utf-8")
    with ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)  # profiles are searched in the working folder
            field_robots = stack.enter_context(start_field_robots(folder, site=folder / "drones.yaml"))
        START_M.update(places_m(field_robots))
        yield field_robots


def test_the_first_ctrl_c_lets_an_arducopter_return_and_waits_for_the_ground(field_robots: FieldRobots) -> None:
    set_parameter(field_robots, Role.SENDER, "RTL_ALT", 100)
    set_parameter(field_robots, Role.SENDER, "WPNAV_RADIUS", 10)
    process = start_flight(field_robots, Role.SENDER, abort="return", lease="60s")
    wait_until(lambda: distance_from_start_m(field_robots, Role.SENDER) > 1.5, Deadline.after(60))
    process.send_signal(signal.SIGINT)
    stopped_run = finish(process)
    assert stopped_run.code == 130
    stop_line, return_line, ground_line = map(
        stopped_run.err.index,
        (
            "stopping: copter-1 returns automatically if it is in the air; this takes up to about ",
            "copter-1: coming down (return)",
            "copter-1: stopped (on the ground)",
        ),
    )
    assert stop_line < return_line < ground_line
    assert height_m(field_robots, Role.SENDER) < 1e-3, "the landing is reported when the drone is on the ground"
    assert_landed(field_robots, Role.SENDER, "return: the job was cancelled")
    assert distance_from_start_m(field_robots, Role.SENDER) < NEAR_M
    wait_until(lambda: not agents(), Deadline.after(60))


def test_a_drone_flies_without_its_laptop_until_abort(field_robots: FieldRobots) -> None:
    """If fieldkit is killed, the drone lands when its lease expires; `fieldkit abort` stops its job earlier."""
    process = start_flight(field_robots, Role.RECEIVER, abort="land", lease="60s")
    process.kill()
    process.communicate(timeout=60)
    wait_for_end({process.pid}, within_s=60.0)
    assert agents()
    assert height_m(field_robots, Role.RECEIVER) > 0.2, "it still flies"
    abort_run = run_here(field_robots.folder, "abort", "--yes")
    assert abort_run.code == 0
    assert "/fly " in abort_run.out, abort_run.err
    assert_landed(field_robots, Role.RECEIVER, "land: the job was cancelled")
    wait_until(lambda: not agents(), Deadline.after(60))


def test_a_second_ctrl_c_does_not_wait_for_the_landing(field_robots: FieldRobots) -> None:
    set_parameter(field_robots, Role.RECEIVER, *SLOW_LANDING)
    process = start_flight(field_robots, Role.RECEIVER, abort="land", lease="60s")
    assert process.stderr is not None
    process.send_signal(signal.SIGINT)
    assert any("duckiedrone-1: coming down (land)" in line for line in process.stderr)
    process.send_signal(signal.SIGINT)
    stopped_run = finish(process)
    assert stopped_run.code == 130
    assert "the order to stop was sent" in stopped_run.err
    assert_landed(field_robots, Role.RECEIVER, "land: the job was cancelled")
    wait_until(lambda: not agents(), Deadline.after(60))


def test_stop_lands_a_drone_after_fieldkit_was_killed(field_robots: FieldRobots) -> None:
    set_parameter(field_robots, Role.RECEIVER, *SLOW_LANDING)
    process = start_flight(field_robots, Role.RECEIVER, abort="land", lease="60s")
    process.kill()
    process.communicate(timeout=60)
    stopped_run = run_here(field_robots.folder, "stop", "--all")
    assert stopped_run.code == 0, stopped_run.err
    assert sorted(stopped_run.out.splitlines()) == [
        "copter-1: no program of fieldkit moves it; nothing was sent to it",
        "duckiedrone-1: coming down (land)",
    ]
    assert_landed(field_robots, Role.RECEIVER, "land: the job was cancelled")
    wait_until(lambda: not agents(), Deadline.after(60))


def set_parameter(field_robots: FieldRobots, role: Role, name: str, value: float) -> None:
    """Set a parameter of an autopilot."""
    program = SET_PARAMETER.format(name=name, value=value)
    field_robots.testbed.shells[role].run((sys.executable, "-c", program), deadline=Deadline.after(60))


def start_flight(field_robots: FieldRobots, role: Role, *, abort: str, lease: str) -> "subprocess.Popen[str]":
    """Wait until the motors are stopped, start a trial, and return when its drone is in the air."""
    field_robots.testbed.shells[role].run((sys.executable, "-c", STATIONARY_DRONE), deadline=Deadline.after(60))
    (field_robots.folder / "procedures").mkdir(exist_ok=True)
    text = PROCEDURE_WITH_LEASE
    for word, value in (("ROLE", role), ("HOW", abort), ("LEASE", lease)):
        text = text.replace(word, value)
    (field_robots.folder / "procedures/givenup.yaml").write_text(text, encoding="utf-8")
    process = start(field_robots.folder, "trial", "givenup", "5m", "--yes", "--allow-motion", "--json")
    wait_for_line(process, f'"fly {field_robots.cast[role].name}"')
    wait_until(lambda: height_m(field_robots, role) > 0.4, Deadline.after(60))
    return process


def assert_landed(field_robots: FieldRobots, role: Role, reason: str) -> None:
    """Wait until the drone is on the ground, and check the reason for the landing in the log of its program."""
    wait_until(lambda: height_m(field_robots, role) < 1e-3, Deadline.after(60))
    shell = field_robots.testbed.shells[role]
    assert reason in shell.run(("sh", "-c", PRINT_NEWEST_LOG), deadline=Deadline.after(30)).stdout.decode()


def displacement_m(field_robots: FieldRobots, role: Role) -> Vector:
    """Return the true position of the drone relative to its initial position."""
    now_m, start_m = places_m(field_robots)[role], START_M[role]
    return now_m[0] - start_m[0], now_m[1] - start_m[1], now_m[2] - start_m[2]


def places_m(field_robots: FieldRobots) -> dict[Role, Vector]:
    """Return the present positions; the oracle drops earlier ones, because tests poll a hundred times per second."""
    track = field_robots.testbed.oracle.track(time.time_ns())
    return {point.role: point.position_m for point in track if point.position_m is not None}


def distance_from_start_m(field_robots: FieldRobots, role: Role) -> float:
    return math.hypot(*displacement_m(field_robots, role)[:2])


def height_m(field_robots: FieldRobots, role: Role) -> float:
    return displacement_m(field_robots, role)[2]


def agents() -> list[str]:
    """Return the command lines of fieldkit's agents on the emulated robots."""
    command_lines = []
    for pid in descendants(os.getpid()):
        with suppress(OSError):  # the process has exited
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            command_lines += [" ".join(map(os.fsdecode, words))] if any(b"/agent-" in word for word in words) else []
    return command_lines

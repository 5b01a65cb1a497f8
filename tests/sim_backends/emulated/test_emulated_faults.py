"""Faults of emulated robots have real effects in the kernel, the processes and the files."""

import os
import re
import time
from collections.abc import Callable, Iterator

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.model import FIXED_ROLES, Fault, FaultKind, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.remote.shell import Shell
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.faults import inject_until_exit
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

BOOT_S = 0.5
LONG_S = 60.0
BOOT_ID = "/proc/sys/kernel/random/boot_id"
RECORD = '. /opt/ros/noetic/setup.bash && rosbag record --duration=1 -O "$0" /scan && ls "$0.bag"'
VOLATILE = ("/tmp/mine", "/run/mine", "/dev/shm/mine")
PERSISTENT = ("/root/mine", "/home/mine", "/var/log/mine")


@pytest.fixture(scope="module", params=[RosChoice.BUILTIN, RosChoice.DEBIAN])
def emulation(request: pytest.FixtureRequest) -> Iterator[EmulatedTestbed]:
    cast = EmulatedBackend(None, None).cast(Topology.MASTER)
    with testbed.bring_up(
        cast,
        options=EmulatedOptions.model_validate({"radio": RadioOptions(fading=False), "boot": f"{BOOT_S}s"}),
        world=load_world("lawn"),
        ros=request.param,
        seed=1,
    ) as robots:
        robots.place(Placement(Scenario.NLOS, Topology.MASTER, parse_distance("5m")))
        yield robots


def output_of(shell: Shell, *argv: str) -> str:
    return shell.run(argv, deadline=Deadline.after(LONG_S)).stdout.decode()


def wait_for_recovery(shell: Shell, condition: Callable[[], bool] = lambda: True) -> None:
    """Return when the robot is reachable and the condition is true."""
    deadline = Deadline.after(LONG_S)
    while True:
        try:
            output_of(shell, "true")
            if condition():
                return
        except (LinkError, RobotError):
            pass
        assert not deadline.expired, "the robot did not recover"
        time.sleep(0.01)


def reaches(emulation: EmulatedTestbed, role: Role, target: Role, *, within_s: float = 10.0) -> bool:
    """Return True if one robot gets an answer from another over the radio."""
    argv = ("ping", "-c", "1", "-W", f"{within_s:g}", emulation.robots[target].spec.ip)
    return emulation.shells[role].run(argv, deadline=Deadline.after(LONG_S), check=False).exit_code == 0


def process_names(shell: Shell) -> list[str]:
    return output_of(shell, "sh", "-c", "cat /proc/[0-9]*/comm 2>/dev/null || true").split()  # some exit meanwhile


def test_a_link_goes_down_and_comes_up_with_all_its_routes(emulation: EmulatedTestbed) -> None:
    sender = emulation.shells[Role.SENDER]
    routes = output_of(sender, "ip", "route")
    assert "224.0.0.0/4" in routes
    with inject_until_exit(emulation, Fault(FaultKind.LINK_DOWN, Role.SENDER, 1.0)):
        assert "state DOWN" in output_of(sender, "ip", "link", "show", "wlan0")
    assert output_of(sender, "ip", "route") == routes
    assert reaches(emulation, Role.RECEIVER, Role.SENDER)


def test_the_duration_of_a_fault_is_returned(emulation: EmulatedTestbed) -> None:
    duration_s = emulation.inject(Fault(FaultKind.LINK_DOWN, Role.RECEIVER, 0.3))
    assert duration_s is not None
    assert 0.3 <= duration_s < LONG_S
    assert emulation.inject(Fault(FaultKind.KILL, Role.RECEIVER, process="sensors")) == 0.0
    wait_for_recovery(
        emulation.shells[Role.RECEIVER], lambda: "sensors" in process_names(emulation.shells[Role.RECEIVER])
    )


@pytest.mark.parametrize("unreachable", FIXED_ROLES)
def test_a_robot_out_of_range_is_unreachable_and_without_the_relay_all_are(
    emulation: EmulatedTestbed, unreachable: Role
) -> None:
    assert reaches(emulation, Role.SENDER, Role.RECEIVER)
    with inject_until_exit(emulation, Fault(FaultKind.OUT_OF_RANGE, unreachable, 1.5)):
        wait_until(lambda: not reaches(emulation, Role.SENDER, Role.RECEIVER, within_s=0.3), Deadline.after(LONG_S))
    assert reaches(emulation, Role.SENDER, Role.RECEIVER), "all robots are back at their places"


def test_a_reboot_kills_every_process_and_keeps_only_the_sd_card(emulation: EmulatedTestbed) -> None:
    sender = emulation.shells[Role.SENDER]
    output_of(
        sender,
        "sh",
        "-c",
        'touch "$@"; mkdir -p /tmp/deep/er; setsid -f sleep 1000 >/dev/null 2>&1',
        "sh",
        *VOLATILE,
        *PERSISTENT,
    )
    boot_id = output_of(sender, "cat", BOOT_ID)
    start_s = time.monotonic()
    assert emulation.inject(Fault(FaultKind.REBOOT, Role.SENDER)) == 0.0
    assert time.monotonic() - start_s >= BOOT_S
    wait_for_recovery(sender, lambda: {"sshd", "sensors"} <= set(process_names(sender)))
    assert "sleep" not in process_names(sender)
    assert re.fullmatch(r"[0-9a-f-]{36}\n", boot_id)
    assert output_of(sender, "cat", BOOT_ID) not in {
        boot_id,
        output_of(emulation.shells[Role.RECEIVER], "cat", BOOT_ID),
    }
    remaining_files = output_of(
        sender, "sh", "-c", 'ls -d "$@" /tmp/deep 2>/dev/null; true', "sh", *VOLATILE, *PERSISTENT
    ).split()
    assert sorted(remaining_files) == sorted(PERSISTENT)
    assert "224.0.0.0/4" in output_of(sender, "ip", "route")
    assert reaches(emulation, Role.RECEIVER, Role.SENDER)


def test_a_robot_records_again_after_a_reboot_and_after_its_sensors_died(emulation: EmulatedTestbed) -> None:
    sender = emulation.shells[Role.SENDER]
    emulation.inject(Fault(FaultKind.REBOOT, Role.SENDER))
    wait_for_recovery(sender, lambda: records_scan(sender, "after-reboot"))
    emulation.inject(Fault(FaultKind.KILL, Role.SENDER, process="sensors"))
    wait_for_recovery(sender, lambda: records_scan(sender, "after-kill"))


def records_scan(shell: Shell, name: str) -> bool:
    result = shell.run(("bash", "-c", RECORD, name), deadline=Deadline.after(LONG_S), check=False)
    return result.stdout.decode().endswith(f"{name}.bag\n")


def test_a_robot_without_power_is_unreachable(emulation: EmulatedTestbed) -> None:
    robot = emulation.robots[Role.RECEIVER]
    robot.halt()
    with pytest.raises(ConnectionError, match="refused"):
        robot.connect(5.0)
    wait_until(lambda: not reaches(emulation, Role.SENDER, Role.RECEIVER, within_s=0.3), Deadline.after(LONG_S))
    robot.boot()
    wait_for_recovery(emulation.shells[Role.RECEIVER])


def test_a_killed_server_restarts_with_another_process_id(emulation: EmulatedTestbed) -> None:
    sender = emulation.shells[Role.SENDER]
    listener = ("sh", "-c", "cd /proc; for p in [0-9]*; do echo sshd | cmp -s - $p/comm && echo $p && break; done")
    pid_before = output_of(sender, *listener)
    emulation.inject(Fault(FaultKind.KILL, Role.SENDER, process="sshd"))
    wait_for_recovery(sender, lambda: output_of(sender, *listener) != pid_before)


def test_a_process_that_does_not_run_cannot_be_killed(emulation: EmulatedTestbed) -> None:
    with pytest.raises(RobotError, match="no process named roscore is running") as error_info:
        emulation.inject(Fault(FaultKind.KILL, Role.SENDER, process="roscore"))
    assert "/proc/[0-9]*/comm" in error_info.value.remedy


def test_a_request_with_a_short_timeout_does_not_affect_later_ones(emulation: EmulatedTestbed) -> None:
    _, descriptors = emulation.robots[Role.SENDER]._worker.request({"do": "socket"}, timeout_s=1e-6)
    for fd in descriptors:
        os.close(fd)
    output_of(emulation.shells[Role.SENDER], "true")

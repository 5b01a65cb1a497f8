"""Running emulated robots with real tools, and their shutdown."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final

import pytest
from rosbags.rosbag1 import Reader

from benchmarks.footprint import Memory
from fieldkit.backends.protocols import Cast
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError, TestbedLostError
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from fieldkit.remote.ssh import SshShell
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.provisioning import KeyPair, robot_spec
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.casts import ros_of
from tests.helpers.host import NamespaceComparison, descendants, wait_for_end
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

SETUP: Final = "/opt/ros/noetic/setup.bash"
LOS: Final = Placement(Scenario.LOS, Topology.MASTER, parse_distance("30ft"))

# Brings up the default lab, prints its process ids, and waits to be killed.
OWNER: Final = """
import json, os, sys
from fieldkit.core.model import Topology
from fieldkit.core.prompts import Unattended
from sim_backends.emulated.backend import EmulatedBackend
backend = EmulatedBackend(None, None)
with backend.open(backend.cast(Topology.MASTER), seed=1, sink=lambda event: None, operator=Unattended()) as lab:
    robots = [robot.pid for robot in lab.robots.values()]
    print(json.dumps({"robots": robots, "medium": lab.medium.pid}), flush=True)
    sys.stdin.read()
"""


def master_cast() -> Cast:
    return EmulatedBackend(None, None).cast(Topology.MASTER)


@pytest.fixture(scope="module", params=[RosChoice.BUILTIN, RosChoice.DEBIAN])
def emulation(request: pytest.FixtureRequest) -> Iterator[EmulatedTestbed]:
    with testbed.bring_up(
        master_cast(),
        options=EmulatedOptions(radio=RadioOptions(fading=False)),
        world=load_world("lawn"),
        ros=request.param,
        seed=1,
    ) as robots:
        robots.place(LOS)
        yield robots


@pytest.fixture
def sender(emulation: EmulatedTestbed) -> Shell:
    return emulation.shells[Role.SENDER]


def output_of(shell: Shell, *argv: str, seconds: float = 30.0) -> str:
    return shell.run(argv, deadline=Deadline.after(seconds)).stdout.decode()


def run_in_ros(shell: Shell, *argv: str) -> str:
    return output_of(shell, *with_environment(argv, setup=[SETUP]), seconds=60)


def messages_in(bag: Path, topic: str) -> list[Any]:
    store = standard_types().ros1
    with Reader(bag) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        return [
            store.deserialize_ros1(data, connection.msgtype) for connection, _, data in reader.messages(connections)
        ]


def namespaces_of(pid: int) -> set[str]:
    """Return the namespaces of a process; a process that has exited has none, or some."""
    result: set[str] = set()
    for name in ("net", "mnt", "pid", "uts", "ipc"):
        with suppress(OSError):
            result.add(str(Path(f"/proc/{pid}/ns/{name}").readlink()))
    return result


def test_a_robot_has_a_separate_name_home_and_hosts_file(sender: Shell) -> None:
    assert output_of(sender, "hostname") == "turtlebot-1\n"
    assert output_of(sender, "pwd") == "/root\n"
    assert output_of(sender, "getent", "hosts", "turtlebot-2").split() == ["10.42.0.2", "turtlebot-2"]
    assert ".bashrc" not in output_of(sender, "ls", "-a", "/root")
    assert socket.gethostname() != "turtlebot-1"


def test_a_robot_changes_nothing_on_the_host(sender: Shell) -> None:
    output_of(sender, "touch", "/root/mine", "/tmp/mine", "/run/mine", "/opt/mine", "/var/log/mine", "/home/mine")
    for path in ("/root/mine", "/tmp/mine", "/run/mine", "/opt/mine", "/var/log/mine", "/home/mine"):
        assert not Path(path).exists()
    for folder in ("/usr", "/etc", "/var/lib", str(ROOT)):
        result = sender.run(("touch", f"{folder}/mine"), deadline=Deadline.after(30), check=False)
        assert b"Read-only file system" in result.stderr


def test_a_lab_leaves_no_trace_on_the_host(untouched: NamespaceComparison) -> None:
    with testbed.bring_up(
        master_cast(), options=EmulatedOptions(), world=load_world("lawn"), ros=RosChoice.BUILTIN, seed=1
    ):
        untouched()


def test_robots_reach_each_other_over_the_medium(emulation: EmulatedTestbed) -> None:
    output = output_of(emulation.shells[Role.SENDER], "ping", "-c", "3", "-w", "30", "-i", "0.01", "turtlebot-2")
    assert "3 received" in output
    assert emulation.medium.stats().ports["turtlebot-1"].sent_packets >= 3


@pytest.mark.parametrize("destination", ["10.42.0.255", "255.255.255.255", "239.1.1.1"])
def test_broadcast_and_multicast_are_sent_by_the_radio(sender: Shell, destination: str) -> None:
    assert "dev wlan0" in output_of(sender, "ip", "route", "get", destination)


def test_the_kernel_sends_nothing_without_a_request(sender: Shell) -> None:
    assert output_of(sender, "ip", "-6", "address") == ""


def test_tcpdump_writes_captures_into_folders_of_root(emulation: EmulatedTestbed) -> None:
    script = (
        "umask 077; mkdir -p ~/deep/er && cd ~/deep/er && "
        "{ timeout 10 tcpdump -n -i wlan0 -c 2 -w x.pcap & } && "
        "until [ -e x.pcap ]; do sleep 0.01; done && ping -q -c 5 -i 0.05 10.42.0.3 && wait && stat -c %s x.pcap"
    )
    size_bytes = int(output_of(emulation.shells[Role.SENDER], "bash", "-c", script).splitlines()[-1])
    # The file has a header of 24 bytes, and for each packet a header of 16 bytes and a ping of 84 bytes.
    assert size_bytes == 24 + 2 * (16 + 84)


def test_no_signal_is_ignored_or_blocked_in_a_session(sender: Shell) -> None:
    status = dict(
        line.split(":\t", 1) for line in output_of(sender, "cat", "/proc/self/status").splitlines() if ":\t" in line
    )
    # Without the real-time signals: glibc's posix_spawn leaves two of them ignored.
    standard = (1 << 31) - 1
    assert int(status["SigIgn"], 16) & standard == 0
    assert int(status["SigBlk"], 16) & standard == 0


def test_only_the_key_of_the_lab_can_log_in(emulation: EmulatedTestbed) -> None:
    robot = emulation.robots[Role.SENDER]
    # OpenSSH 9.9 prints its comments to standard output, too.
    key_lines = output_of(emulation.shells[Role.SENDER], "ssh-keyscan", "127.0.0.1").splitlines()
    _, host_key = next(line for line in key_lines if not line.startswith("#")).split(maxsplit=1)
    other_login = SshShell(
        robot.name,
        connect=robot.connect,
        user=USER,
        host_key=host_key,
        private_key=KeyPair.make().private,
    )
    with pytest.raises(RobotError, match="refused the login"):
        other_login.run(["true"], deadline=Deadline.after(30))
    other_login.close()


def rate_of(times_s: list[float]) -> float:
    """Return the messages per second, insensitive to one late message at either end."""
    half = len(times_s) // 2
    return half / median(later - earlier for earlier, later in zip(times_s[:half], times_s[half:], strict=False))


@pytest.mark.quiet
def test_a_recorded_scan_has_the_sensor_s_rate_and_the_real_size(sender: Shell, tmp_path: Path) -> None:
    run_in_ros(sender, "rosbag", "record", "--duration=5", "-O", "scan", "/scan")
    bag = tmp_path / "scan.bag"
    sender.fetch(("cat", "scan.bag"), bag, deadline=Deadline.after(30), limit_bytes=1 << 20)
    scans = messages_in(bag, "/scan")
    stamps_s = [scan.header.stamp.sec + scan.header.stamp.nanosec / 1e9 for scan in scans]
    sequence = [scan.header.seq for scan in scans]
    assert sequence == list(range(sequence[0], sequence[0] + len(scans)))
    assert 15 <= len(scans) <= 25, "5 s of a 5 Hz laser, less the time to subscribe"
    assert rate_of(stamps_s) == pytest.approx(5.0, rel=0.01)
    assert {scan.header.frame_id for scan in scans} == {"base_scan"}
    assert all(len(scan.ranges) == len(scan.intensities) == 360 for scan in scans)
    # A message with a frame of 9 letters has 57 + 4 + 8 * 360 bytes, and the bag adds 58 bytes to each. The rest of
    # the bag has 9,063 bytes with ROS, and 5,387 without, because the message definition, which a bag contains twice,
    # then has no comments.
    assert bag.stat().st_size - len(scans) * (57 + 4 + 8 * 360 + 58) in {9_063, 5_387}


@pytest.mark.quiet
def test_all_topics_keep_their_rates(sender: Shell, tmp_path: Path) -> None:
    rates_hz = {topic.name: topic.rate for topic in ros_of(master_cast()[Role.SENDER].profile).topics}
    run_in_ros(sender, "rosbag", "record", "--duration=3", "-O", "all", *rates_hz)
    bag = tmp_path / "all.bag"
    sender.fetch(("cat", "all.bag"), bag, deadline=Deadline.after(30), limit_bytes=8 << 20)
    for topic, rate_hz in rates_hz.items():
        messages = messages_in(bag, topic)
        stamps = [
            message.transforms[0].header.stamp if topic == "/tf" else message.header.stamp for message in messages
        ]
        times_s = [stamp.sec + stamp.nanosec / 1e9 for stamp in stamps]
        assert rate_of(times_s) == pytest.approx(rate_hz, rel=0.02), topic


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_lab_stops_after_any_error(error: type[BaseException]) -> None:
    processes: set[int] = set()

    def run_lab() -> None:
        with testbed.bring_up(
            master_cast(), options=EmulatedOptions(), world=load_world("lawn"), ros=RosChoice.BUILTIN, seed=1
        ) as robots:
            for pid in (*(robot.pid for robot in robots.robots.values()), robots.medium.pid):
                processes.update({pid, *descendants(pid)})
            raise error

    with pytest.raises(error):
        run_lab()
    assert len(processes) > 3 * 4
    wait_for_end(processes, within_s=0.0)


def start_owner(folder: Path) -> tuple[subprocess.Popen[str], dict[str, Any]]:
    """Start a process that owns a lab; `folder` is the clone that it runs from."""
    process = subprocess.Popen(
        [sys.executable, "-c", OWNER],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    return process, json.loads(process.stdout.readline())


def test_sigkill_of_the_owner_leaves_no_processes(untouched: NamespaceComparison) -> None:
    process, pids = start_owner(ROOT)
    lab_pids = {pid for root in (*pids["robots"], pids["medium"]) for pid in (root, *descendants(root))}
    namespaces = set().union(*(namespaces_of(pid) for robot in pids["robots"] for pid in descendants(robot)))
    namespaces -= namespaces_of(os.getpid())
    assert len(namespaces) == 5 * 3
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_for_end(lab_pids, within_s=60.0)
    # A namespace exists as long as a process or a mount uses it. The kernel reuses its number, so `untouched` checks.
    untouched()


@pytest.mark.parametrize("parent", mark_nightly(["/root", "/tmp", "/opt"]))
def test_a_clone_works_in_any_folder(parent: str) -> None:
    folder = Path(parent, f"fieldkit clone {os.getpid()}")
    try:
        for name in ("fieldkit", "sim_backends", "robots"):
            shutil.copytree(ROOT / name, folder / name)  # with compiled modules, which saves time
        process, _ = start_owner(folder)
        process.communicate("", timeout=60)
        assert process.returncode == 0
    finally:
        shutil.rmtree(folder)


def robot_without_lab(stack: ExitStack, **changes: str) -> EmulatedRobot:
    cast = master_cast()
    spec = robot_spec(cast, Role.SENDER, ros=RosChoice.BUILTIN, login=KeyPair.make(), host_key=KeyPair.make())
    return stack.enter_context(EmulatedRobot(replace(spec, **changes)))  # type: ignore[arg-type]


def test_a_server_that_does_not_start_is_named_with_its_output() -> None:
    with ExitStack() as stack:
        robot = robot_without_lab(stack, host_key="no key")
        robot.build()
        robot.open_radio()
        with pytest.raises(RobotError, match=r"turtlebot-1: sshd exited with status 1: .*no hostkeys available"):
            robot.start()


def test_a_robot_uses_less_than_15_mb_of_unshared_memory() -> None:
    """Two robots run, so that pages of programs are shared even if no other program on this machine uses them."""
    with ExitStack() as stack:
        robots = [robot_without_lab(stack) for _ in range(2)]
        for robot in robots:
            robot.build()
            robot.open_radio()
            robot.start()
        assert Memory.of(robots[0].pid).own_bytes < 15e6


def test_a_rejected_address_is_reported() -> None:
    with ExitStack() as stack:
        robot = robot_without_lab(stack, address="10.42.0.1/99")
        robot.build()
        with pytest.raises(RobotError, match="turtlebot-1: ip rejected a setting"):
            robot.open_radio()


def test_a_killed_robot_is_reported() -> None:
    with ExitStack() as stack:
        robot = robot_without_lab(stack)
        robot.build()
        os.kill(robot.pid, signal.SIGKILL)
        with pytest.raises(TestbedLostError, match=r"turtlebot-1, pid .* does not answer: it was killed by SIGKILL"):
            robot.start()
        # An OSError would mean a link that may recover, and would be retried.
        with pytest.raises(TestbedLostError, match=r"turtlebot-1, pid .* does not answer: it was killed by SIGKILL"):
            robot.connect(1.0)
        robot.close()
        robot.close()

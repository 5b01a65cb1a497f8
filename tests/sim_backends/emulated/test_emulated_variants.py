"""Robots with other tools than this machine: a tool's name starts the configured variant."""

import contextlib
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import paramiko
import pytest

from fieldkit.backends.protocols import Cast
from fieldkit.config.schema import parse
from fieldkit.config.site import Site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.core.model import Fault, FaultKind, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.remote.command import with_environment
from sim_backends.emulated import requirements, testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RobotOptions, RosChoice, load_options
from sim_backends.emulated.provisioning import KeyPair
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world

SITE: Final = """\
robots:
  a: {profile: turtlebot3_burger}
roles: {}
emulated:
  robots:
    a: {netcat: openbsd, sftp: false}
"""
KEY: Final = KeyPair.make()
SETUP: Final = "/opt/ros/noetic/setup.bash"


def cast() -> Cast:
    return EmulatedBackend(None, None).cast(Topology.MASTER)


def backend(text: str) -> EmulatedBackend:
    document = parse(text, source="fieldkit.yaml")
    return EmulatedBackend(Site.model_validate(document.data), document)


@pytest.fixture(scope="module")
def emulation() -> Iterator[EmulatedTestbed]:
    variants = {
        "turtlebot-1": RobotOptions(ssh="dropbear", sftp=False, userland="busybox"),
        "turtlebot-2": RobotOptions(netcat="openbsd", ping="busybox", sftp=False),
        "duckiedrone-1": RobotOptions(ssh="dropbear", netcat="ncat", userland="busybox", ping="iputils"),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KeyPair, "make", lambda: KEY)
        with testbed.bring_up(
            cast(),
            options=EmulatedOptions.model_validate(
                {"radio": RadioOptions(fading=False), "robots": variants, "boot": "0.1s"}
            ),
            world=load_world("lawn"),
            ros=RosChoice.BUILTIN,
            seed=1,
        ) as robots:
            robots.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("30ft")))
            yield robots


def output_of(emulation: EmulatedTestbed, role: Role, *argv: str) -> str:
    """Return both output streams of a program that may fail: some programs print their version and fail."""
    result = emulation.shells[role].run(argv, deadline=Deadline.after(60), check=False)
    return (result.stdout + result.stderr).decode()


def has_program(emulation: EmulatedTestbed, role: Role, program: str) -> bool:
    return bool(output_of(emulation, role, "sh", "-c", f"command -v {program}"))


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("role", "output_part"),
    [(Role.SENDER, "BusyBox"), (Role.RECEIVER, "OpenBSD netcat"), (Role.RELAY, "Ncat 7")],
)
def test_the_netcat_of_a_robot_is_the_only_one_it_has(
    emulation: EmulatedTestbed, role: Role, output_part: str
) -> None:
    assert output_part in output_of(emulation, role, "nc", "-h")
    expected = {Role.SENDER: set(), Role.RECEIVER: {"nc.openbsd"}, Role.RELAY: {"ncat"}}[role]
    assert {
        name for name in ("nc.traditional", "nc.openbsd", "ncat") if has_program(emulation, role, name)
    } == expected


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("role", "output_part"), [(Role.SENDER, "seq=0"), (Role.RECEIVER, "seq=0"), (Role.RELAY, "icmp_seq=1")]
)
def test_the_ping_of_a_robot_crosses_the_radio(emulation: EmulatedTestbed, role: Role, output_part: str) -> None:
    other = "10.42.0.1" if role is Role.RELAY else "10.42.0.3"
    assert output_part in output_of(emulation, role, "ping", "-c", "1", other)


@pytest.mark.emulated
@pytest.mark.parametrize("role", [Role.SENDER, Role.RELAY])
def test_a_busybox_userland_has_no_other_programs(emulation: EmulatedTestbed, role: Role) -> None:
    for program in ("sh", "tar", "ip", "tail", "sha256sum", "setsid"):
        assert output_of(emulation, role, "readlink", f"/usr/bin/{program}") == "/usr/bin/busybox\n"
    for program in ("perl", "flock", "systemctl", "scp", "getent", "useradd"):
        assert not has_program(emulation, role, program)
    assert output_of(emulation, role, "sh", "-c", "echo $SHELL") == "/bin/sh\n"


@pytest.mark.emulated
def test_a_busybox_robot_records_and_captures(emulation: EmulatedTestbed) -> None:
    record_command = ("rosbag", "record", "--duration=0.5", "-O", "scan", "/scan")
    assert "Recording to 'scan.bag'" in output_of(
        emulation, Role.SENDER, *with_environment(record_command, setup=[SETUP])
    )
    capture = "timeout 10 tcpdump -n -i wlan0 -c 2 -w x.pcap 2>/dev/null; wc -c <x.pcap"
    output = output_of(emulation, Role.SENDER, "sh", "-c", f"ping -q -c 50 -i 0.1 10.42.0.3 >/dev/null & {capture}")
    # The file has a header of 24 bytes, and for each packet a header of 16 bytes and a ping of 84 bytes.
    assert int(output) == 24 + 2 * (16 + 84)


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("role", "server", "sftp"),
    [(Role.SENDER, "dropbear", False), (Role.RECEIVER, "OpenSSH", False), (Role.RELAY, "dropbear", True)],
)
def test_the_ssh_server_is_the_configured_one(
    emulation: EmulatedTestbed, role: Role, server: str, *, sftp: bool
) -> None:
    key = paramiko.Ed25519Key.from_private_key(io.StringIO(KEY.private))
    with paramiko.Transport(emulation.robots[role].connect(10.0)) as link:
        link.connect(username=USER, pkey=key)
        assert server in link.remote_version
        assert offers_sftp(link) is sftp


def offers_sftp(link: paramiko.Transport) -> bool:
    try:
        client = paramiko.SFTPClient.from_transport(link)
        return client is not None and client.normalize(".") == "/root"
    except (paramiko.SSHException, EOFError, OSError):
        # The server refuses the subsystem, or its program exits before or after the first request is sent.
        return False


@pytest.mark.emulated
def test_a_robot_with_other_tools_recovers_from_a_reboot(emulation: EmulatedTestbed) -> None:
    boot = ("cat", "/proc/sys/kernel/random/boot_id")
    before = output_of(emulation, Role.SENDER, *boot)
    emulation.inject(Fault(FaultKind.REBOOT, Role.SENDER))
    assert wait_for(
        lambda: emulation.shells[Role.SENDER].run(boot, deadline=Deadline.after(20)).stdout.decode() != before
    )
    assert "seq=0" in output_of(emulation, Role.SENDER, "ping", "-c", "1", "10.42.0.3")


def wait_for(condition: Callable[[], bool]) -> bool:
    deadline = Deadline.after(60)
    while not deadline.expired:
        with contextlib.suppress(LinkError):
            if condition():
                return True
        time.sleep(0.01)
    return False


def test_options_name_robots_of_the_lab() -> None:
    assert load_options(parse(SITE, source="fieldkit.yaml")).robots == {
        "a": RobotOptions(netcat="openbsd", sftp=False)
    }
    backend(SITE)
    with pytest.raises(ConfigurationError, match=r"fieldkit.yaml:6: emulated.robots names 'b'.*\n.*robots are: a"):
        backend(SITE.replace("    a: {netcat", "    b: {netcat"))


@pytest.mark.parametrize(
    ("invalid_option", "message"),
    [
        ("netcat: bsd", "in emulated.robots.a.netcat: .*'openbsd'"),
        ("netcut: openbsd", "did you mean 'netcat'"),
        ("sftp: 0", "in emulated.robots.a.sftp"),
    ],
)
def test_wrong_variants_are_named_with_their_line(invalid_option: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"fieldkit.yaml:6: .*{message}"):
        backend(SITE.replace("netcat: openbsd, sftp: false", invalid_option))


def test_a_variant_whose_package_is_missing_is_named_with_the_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(requirements, "PATH", str(tmp_path))
    for program in requirements.PACKAGE_OF:
        (tmp_path / program).touch(mode=0o755)
    needed_programs = RobotOptions(ssh="dropbear", netcat="openbsd", ping="busybox").programs()
    with pytest.raises(
        ConfigurationError,
        match=r"busybox, dropbear, .*nc.openbsd\n.*apt-get install .* busybox dropbear-bin netcat-openbsd$",
    ):
        requirements.check(needed_programs)


def test_every_variant_has_its_package() -> None:
    all_programs = set(requirements.PACKAGE_OF | requirements.VARIANT_PACKAGE_OF)
    for field, value in (
        ("ssh", "dropbear"),
        ("userland", "busybox"),
        ("ping", "busybox"),
        *(("netcat", name) for name in ("traditional", "openbsd", "ncat", "busybox")),
    ):
        assert RobotOptions.model_validate({field: value}).programs() <= all_programs
    assert RobotOptions().programs() == set()
    assert EmulatedOptions().robots == {}

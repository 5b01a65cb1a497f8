"""A mesh of six robots in a row, of which only neighbours are in range, with Debian's babeld.

One of them has a busybox userland. The operator's laptop is beside the first.
"""

import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.lab.robots import LabRobot
from fieldkit.remote.ssh import SshShell
from sim_backends.emulated import requirements
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.nodes import Laptop
from sim_backends.emulated.provisioning import LAPTOP_ADDRESS, LAPTOP_NAME, profile_in_lab
from sim_backends.emulated.robot import network
from sim_backends.emulated.robot.mesh_options import MeshOptions
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.running_robots import RunningRobots, running_robots
from sim_backends.emulated.testbed import laptop_on_air
from sim_backends.world.world import load_world
from tests.helpers.labs import BOX
from tests.helpers.sshd import wait_until

NAMES = ("r1", "r2", "r3", "r4", "r5", "r6")
ADDRESSES = {name: f"10.42.0.{number}" for number, name in enumerate(NAMES, 1)}
HELLO_S = 0.5
# 17 dBm less 40.2 dB for the first metre (2.437 GHz) and 53.3 dB up to 60 m arrive as -76.5 dBm, 6 dB above the
# sensitivity of the radio; at twice the distance the signal is 9 dB weaker, which is below it.
SPACING_M = 60.0
FIRST_TTL = 64
LONG_S = 60.0


@dataclass(frozen=True)
class Row:
    robots: RunningRobots[str]
    laptop: Laptop


@pytest.fixture(scope="module")
def row() -> Iterator[Row]:
    profile = schema.validate(schema.parse(BOX, source="box.yaml"), RobotProfile)
    mesh = f"{{protocol: babel, hello: {HELLO_S}s}}"
    text = f"{{radio: {{fading: false}}, mesh: {mesh}, robots: {{r3: {{userland: busybox}}}}}}"
    options = schema.validate(schema.parse(text, source="fieldkit.yaml"), EmulatedOptions)
    members = {name: LabRobot(name, profile, address, ()) for name, address in ADDRESSES.items()}
    with (
        running_robots(
            members, options=options, world=load_world("open"), ros=RosChoice.BUILTIN, seed=1
        ) as running_lab,
        laptop_on_air(running_lab, options.mesh) as laptop,
    ):
        places = {name: (SPACING_M * number, 0.0, 0.2) for number, name in enumerate(NAMES)}
        running_lab.medium.place(places | {LAPTOP_NAME: (0.0, 2.0, 0.2)})
        yield Row(running_lab, laptop)


@pytest.fixture(scope="module")
def first_shell(row: Row) -> Iterator[SshShell]:
    """Return the shell of the first robot when its routing daemon has a route to the last robot."""
    with ExitStack() as stack:
        shell = SshShell(
            "r1",
            connect=row.robots.robots["r1"].connect,
            user=USER,
            host_key=row.robots.host_keys["r1"],
            private_key=row.robots.private_key,
        )
        stack.callback(shell.close)
        wait_until(lambda: routes_over_neighbours(shell) and reaches_last(shell), Deadline.after(LONG_S))
        yield shell


def routes_over_neighbours(shell: SshShell) -> bool:
    """Return True if the routes of the first robot are those over its neighbours."""
    routes = output_of(shell, "ip", "-4", "route", "show", "proto", "babel").splitlines()
    route_to_laptop = f"{LAPTOP_ADDRESS} via {LAPTOP_ADDRESS}"
    routes_over_r2 = {f"{ADDRESSES[name]} via 10.42.0.2" for name in NAMES[1:]}
    return {line.split(" dev")[0] for line in routes} == {route_to_laptop, *routes_over_r2}


def reaches_last(shell: SshShell) -> bool:
    """Return True if twenty packets to the last robot are answered, each forwarded by four robots."""
    text = ping(shell, "r6", "-c", "20", "-i", "0.05")
    return re.findall(r"ttl=(\d+)", text) == [str(FIRST_TTL - 4)] * 20


def output_of(shell: SshShell, *argv: str) -> str:
    return shell.run(argv, deadline=Deadline.after(LONG_S), check=False).stdout.decode()


def ping(shell: SshShell, name: str, *options: str) -> str:
    return output_of(shell, "ping", "-n", "-W", "1", *options, ADDRESSES[name])


@pytest.mark.emulated
def test_each_of_five_hops_decrements_the_time_to_live(first_shell: SshShell) -> None:
    wait_until(lambda: reaches_last(first_shell), Deadline.after(LONG_S))


@pytest.mark.emulated
def test_a_traceroute_follows_the_row(first_shell: SshShell) -> None:
    def expired_at(ttl: int) -> list[str]:
        return re.findall(
            r"From (\S+) icmp_seq=1 Time to live exceeded", ping(first_shell, "r6", "-c", "1", "-t", str(ttl))
        )

    for ttl, (_, name) in enumerate(pairwise(NAMES[:-1]), 1):
        wait_until(lambda: expired_at(ttl) == [ADDRESSES[name]], Deadline.after(LONG_S))  # noqa: B023 (called immediately)
    wait_until(lambda: "ttl=60" in ping(first_shell, "r6", "-c", "1", "-t", "5"), Deadline.after(LONG_S))


@pytest.mark.emulated
def test_only_neighbours_receive_each_other(row: Row, first_shell: SshShell) -> None:
    frames_before = delivered_frames(row)
    wait_until(lambda: reaches_last(first_shell), Deadline.after(LONG_S))
    receivers = {pair for pair, frames in delivered_frames(row).items() if frames > frames_before.get(pair, 0)}
    assert receivers == {*pairwise(NAMES), *pairwise(reversed(NAMES))}


def delivered_frames(row: Row) -> dict[tuple[str, str], int]:
    """Return the number of frames that each robot has received from each other robot."""
    links = row.robots.medium.stats().links
    return {pair: link.delivered for pair, link in links.items() if LAPTOP_NAME not in pair}


@pytest.mark.emulated
def test_every_route_is_from_babel_and_over_a_neighbour(first_shell: SshShell) -> None:
    wait_until(lambda: routes_over_neighbours(first_shell), Deadline.after(LONG_S))


@pytest.mark.emulated
def test_the_laptop_reaches_the_ssh_server_of_the_last_robot_over_all_others(row: Row, first_shell: SshShell) -> None:
    wait_until(lambda: reaches_last(first_shell), Deadline.after(LONG_S))
    # TCP retries until r6 has found the reverse route too.
    with row.laptop.reach(ADDRESSES["r6"], LONG_S) as stream:
        assert stream.recv(4) == b"SSH-"


@pytest.mark.emulated
def test_a_multicast_reaches_neighbours_and_is_not_forwarded(first_shell: SshShell) -> None:
    neighbours = {"fe80::aff:fe2a:2", "fe80::aff:fe2a:fe"}
    receivers: set[str] = set()
    deadline = Deadline.after(LONG_S)
    # The neighbours answer at the same time, and their answers may collide.
    while not receivers >= neighbours and not deadline.expired:
        text = output_of(first_shell, "ping", "-n", "-c", "2", "-i", "0.2", "-W", "1", "ff02::1%wlan0")
        receivers.update(re.findall(r"bytes from (\S+?)%wlan0:", text))
    assert receivers - {"fe80::aff:fe2a:1"} == neighbours


def test_the_laptop_announces_only_its_address() -> None:
    settings = network.guest_babeld_command("wlan0", "10.42.0.254/24", HELLO_S)
    assert [word for word in settings if word.startswith("out ")] == ["out ip 10.42.0.254/32 allow", "out deny"]


def test_a_missing_daemon_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name, **_: None if name == "babeld" else f"/bin/{name}")
    with pytest.raises(ConfigurationError) as error_info:
        requirements.check({"babeld"})
    assert error_info.value.what == "emulated robots need programs that are not installed: babeld"
    assert error_info.value.remedy.endswith("apt-get install --no-install-recommends babeld")


def test_the_former_key_selects_babel() -> None:
    for text, expected in (
        ("{daemon: babeld}", MeshOptions(protocol="babel")),
        ("{daemon: babeld, hello: 0.5s}", MeshOptions.model_validate({"protocol": "babel", "hello": "500ms"})),
    ):
        assert schema.validate(schema.parse(text, source="x.yaml"), MeshOptions) == expected
    for text in ("{daemon: olsrd}", "{daemon: babeld, protocol: babel}", "{}"):
        with pytest.raises(ConfigurationError, match=r"daemon|protocol"):
            schema.validate(schema.parse(text, source="x.yaml"), MeshOptions)


def test_the_default_interval_is_that_of_the_protocol() -> None:
    assert MeshOptions(protocol="babel").hello_s == 4.0
    assert MeshOptions(protocol="batman-adv").hello_s == 1.0


def test_only_a_mesh_of_batman_changes_the_interface_under_test() -> None:
    text = BOX.strip() + "\nlinks: {wifi: wlan0, cell: wwan0}\n"
    profile = schema.validate(schema.parse(text, source="box.yaml"), RobotProfile)
    babel = EmulatedOptions.model_validate({"wifi": "linux", "mesh": {"protocol": "babel"}})
    assert profile_in_lab(profile, babel) == profile
    batman = EmulatedOptions.model_validate({"wifi": "linux", "mesh": {"protocol": "batman-adv"}})
    in_lab = profile_in_lab(profile, batman)
    assert in_lab.radio.interface == "bat0"
    assert in_lab.further_links == profile.further_links == {"cell": "wwan0"}
    assert profile_in_lab(in_lab, batman) == in_lab


def test_a_kernel_without_batman_is_reported_with_the_command_that_loads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requirements, "_BATMAN_MODULE", tmp_path / "batman_adv")
    with pytest.raises(ConfigurationError) as error_info:
        requirements.check_batman()
    assert "modprobe batman-adv" in error_info.value.remedy
    (tmp_path / "batman_adv").mkdir()
    requirements.check_batman()

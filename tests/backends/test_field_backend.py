"""The field backend with a real sshd on loopback: the site file, requests to the operator, and pinned host keys."""

import re
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Backend
from fieldkit.backends.registry import load_backend
from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.prompts import DONE, Answer, Question, Unattended
from fieldkit.core.units import parse_distance
from fieldkit.trial.running import preflight
from tests.helpers.sshd import Server, make_key

pytestmark = pytest.mark.emulated

SITE = """\
backend: field
robots:
  turtlebot-1: {{profile: turtlebot3_burger, address: 10.0.0.2, {same}}}
  duckiedrone-1: {{profile: duckiedrone, {access}}}
roles:
  masterless: {{sender: turtlebot-1, receiver: duckiedrone-1}}
"""


def site(robot_keys: str) -> str:
    """Return a site file with two robots, which are the same server under two host names."""
    return SITE.format(access=robot_keys, same=robot_keys.replace("127.0.0.1", "localhost"))


class RecordingOperator:
    """An operator that records the requests."""

    def __init__(self) -> None:
        self.prompts: list[str] = []

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        self.prompts.append(request)
        return DONE

    def enter(self, question: Question) -> str:
        raise AssertionError(question)


@pytest.fixture
def robot_keys(server: Server, tmp_path: Path) -> str:
    key = tmp_path / "key"
    key.write_text(server.private_key, encoding="ascii")
    host_key = " ".join(server.host_key.split()[:2])
    return f"host: 127.0.0.1, port: {server.port}, user: root, key: {key}, host_key: {host_key}"


def backend(tmp_path: Path, robot_keys: str) -> Backend:
    path = tmp_path / "fieldkit.yaml"
    path.write_text(site(robot_keys), encoding="utf-8")
    return load_backend("field", *load_site(path))


def test_robots_are_connected_and_placed_by_the_operator(tmp_path: Path, robot_keys: str) -> None:
    field_backend = backend(tmp_path, robot_keys)
    robots_by_role = field_backend.cast(Topology.MASTERLESS)
    assert robots_by_role[Role.SENDER].address == "10.0.0.2"
    assert robots_by_role[Role.RECEIVER].address == "127.0.0.1", "the host is the default of the address"
    operator = RecordingOperator()
    with field_backend.open(robots_by_role, seed=1, sink=lambda event: None, operator=operator) as lab:
        lab.place(Placement(Scenario.NLOS, Topology.MASTERLESS, parse_distance("30ft")))
        for shell in lab.shells.values():
            assert shell.run(("echo", "up"), deadline=Deadline.after(20)).stdout == b"up\n"
    assert operator.prompts == ["move turtlebot-1 to 30 ft (9.14 m) from duckiedrone-1, behind the wall"]


def test_changed_host_key_is_an_error(tmp_path: Path, robot_keys: str) -> None:
    other_key = " ".join(make_key(tmp_path / "other").split()[:2])
    field_backend = backend(tmp_path, re.sub(r"host_key: .*", f"host_key: {other_key}", robot_keys))
    robots_by_role = field_backend.cast(Topology.MASTERLESS)
    with (
        field_backend.open(robots_by_role, seed=1, sink=lambda event: None, operator=Unattended()) as lab,
        pytest.raises(RobotError, match="host key changed") as error_info,
    ):
        preflight.connect_all(robots_by_role, lab.shells, lambda event: None)
    assert "turtlebot-1" in error_info.value.what
    assert "duckiedrone-1" in error_info.value.what, "connections to all robots are attempted"


@pytest.mark.parametrize("key", ["host", "user", "host_key"])
def test_missing_key_of_site_file_is_reported_with_line(tmp_path: Path, robot_keys: str, key: str) -> None:
    incomplete_access = re.sub(rf"\b{key}: [^,]+(, )?", "", robot_keys)
    with pytest.raises(ConfigurationError, match=f"'turtlebot-1' has no {key}") as error_info:
        backend(tmp_path, incomplete_access)
    assert error_info.value.where.endswith("fieldkit.yaml:3")


def test_error_of_topology_without_roles_names_the_key(tmp_path: Path, robot_keys: str) -> None:
    with pytest.raises(ConfigurationError, match="no roles for topology master") as error_info:
        backend(tmp_path, robot_keys).cast(Topology.MASTER)
    assert "roles.master" in error_info.value.remedy


def test_unreadable_key_file_is_named(tmp_path: Path, robot_keys: str) -> None:
    field_backend = backend(tmp_path, re.sub(r"key: \S+key,", "key: /no/such/key,", robot_keys))
    robots_by_role = field_backend.cast(Topology.MASTERLESS)
    with (
        pytest.raises(ConfigurationError, match="/no/such/key cannot be read"),
        field_backend.open(robots_by_role, seed=1, sink=lambda event: None, operator=Unattended()),
    ):
        raise AssertionError("the testbed was opened")


def test_robots_drive_automatically_only_if_allowed(tmp_path: Path, robot_keys: str) -> None:
    field_backend = backend(tmp_path, robot_keys)
    for permissions in ((), ("motion-after-fault",), ("another",)):
        field_backend.permissions = frozenset(permissions)
        assert not any(robot.abilities for robot in field_backend.cast(Topology.MASTERLESS).values())
    field_backend.permissions = frozenset({"motion"})
    robots_by_role = field_backend.cast(Topology.MASTERLESS)
    abilities = {role: set(robot.abilities) for role, robot in robots_by_role.items()}
    assert abilities == {Role.SENDER: {"drive"}, Role.RECEIVER: {"mavlink"}}, "a drone does not drive"
    operator = RecordingOperator()
    with field_backend.open(robots_by_role, seed=1, sink=lambda event: None, operator=operator) as lab:
        lab.place(Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("5m")))
        lab.bring_back(Role.SENDER, has_returned=True)
        lab.bring_back(Role.SENDER, has_returned=False)
    assert operator.prompts == [
        (
            "move turtlebot-1 to 5 m from duckiedrone-1, nothing between them; let turtlebot-1 face away from "
            "duckiedrone-1 with a clear path: it drives automatically"
        ),
        "bring turtlebot-1 back to its place",
    ]

"""The field backend with a real sshd on loopback: site file, requests to the operator, pinned host keys."""

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


def site(access: str) -> str:
    """Return a site file with two robots, which are one server under two host names."""
    return SITE.format(access=access, same=access.replace("127.0.0.1", "localhost"))


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
def access(server: Server, tmp_path: Path) -> str:
    key = tmp_path / "key"
    key.write_text(server.private_key, encoding="ascii")
    host_key = " ".join(server.host_key.split()[:2])
    return f"host: 127.0.0.1, port: {server.port}, user: root, key: {key}, host_key: {host_key}"


def backend(tmp_path: Path, access: str) -> Backend:
    path = tmp_path / "fieldkit.yaml"
    path.write_text(site(access), encoding="utf-8")
    return load_backend("field", *load_site(path))


def test_robots_are_connected_and_placed_by_the_operator(tmp_path: Path, access: str) -> None:
    field = backend(tmp_path, access)
    cast = field.cast(Topology.MASTERLESS)
    assert cast[Role.SENDER].address == "10.0.0.2"
    assert cast[Role.RECEIVER].address == "127.0.0.1", "the host is the default of the address"
    operator = RecordingOperator()
    with field.open(cast, seed=1, sink=lambda event: None, operator=operator) as lab:
        lab.place(Placement(Scenario.NLOS, Topology.MASTERLESS, parse_distance("30ft")))
        for shell in lab.shells.values():
            assert shell.run(("echo", "up"), deadline=Deadline.after(20)).stdout == b"up\n"
    assert operator.prompts == ["move turtlebot-1 to 30 ft (9.14 m) from duckiedrone-1, behind the wall"]


def test_changed_host_key_is_an_error(tmp_path: Path, access: str) -> None:
    other = " ".join(make_key(tmp_path / "other").split()[:2])
    field = backend(tmp_path, re.sub(r"host_key: .*", f"host_key: {other}", access))
    cast = field.cast(Topology.MASTERLESS)
    with (
        field.open(cast, seed=1, sink=lambda event: None, operator=Unattended()) as lab,
        pytest.raises(RobotError, match="host key changed") as caught,
    ):
        preflight.connect_all(cast, lab.shells, lambda event: None)
    assert "turtlebot-1" in caught.value.what
    assert "duckiedrone-1" in caught.value.what, "all robots are tried"


@pytest.mark.parametrize("key", ["host", "user", "host_key"])
def test_missing_key_of_site_file_is_reported_with_line(tmp_path: Path, access: str, key: str) -> None:
    less = re.sub(rf"\b{key}: [^,]+(, )?", "", access)
    with pytest.raises(ConfigurationError, match=f"'turtlebot-1' has no {key}") as caught:
        backend(tmp_path, less)
    assert caught.value.where.endswith("fieldkit.yaml:3")


def test_error_of_topology_without_roles_names_the_key(tmp_path: Path, access: str) -> None:
    with pytest.raises(ConfigurationError, match="no roles for topology master") as caught:
        backend(tmp_path, access).cast(Topology.MASTER)
    assert "roles.master" in caught.value.remedy


def test_unreadable_key_file_is_named(tmp_path: Path, access: str) -> None:
    field = backend(tmp_path, re.sub(r"key: \S+key,", "key: /no/such/key,", access))
    cast = field.cast(Topology.MASTERLESS)
    with (
        pytest.raises(ConfigurationError, match="/no/such/key cannot be read"),
        field.open(cast, seed=1, sink=lambda event: None, operator=Unattended()),
    ):
        raise AssertionError("opened")


def test_robots_drive_automatically_only_if_allowed(tmp_path: Path, access: str) -> None:
    field = backend(tmp_path, access)
    for permissions in ((), ("motion-after-fault",), ("another",)):
        field.permissions = frozenset(permissions)
        assert not any(robot.abilities for robot in field.cast(Topology.MASTERLESS).values())
    field.permissions = frozenset({"motion"})
    cast = field.cast(Topology.MASTERLESS)
    abilities = {role: set(robot.abilities) for role, robot in cast.items()}
    assert abilities == {Role.SENDER: {"drive"}, Role.RECEIVER: {"mavlink"}}, "a drone does not drive"
    operator = RecordingOperator()
    with field.open(cast, seed=1, sink=lambda event: None, operator=operator) as lab:
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

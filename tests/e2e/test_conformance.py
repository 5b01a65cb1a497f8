"""The conformance suite for every connection from fieldkit to a robot."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.backends.registry import load_backend
from fieldkit.config.site import load_site
from fieldkit.core.model import Fault, FaultKind, Placement, Role, Scenario, Topology
from fieldkit.core.prompts import Unattended
from fieldkit.core.units import parse_distance
from fieldkit.remote.sockets import Timing
from fieldkit.remote.ssh import CONNECT_S
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.testbed import EmulatedTestbed
from tests.helpers.conformance import BackendConformance, RebootConformance, ShellConformance, Subject
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.forwarder import Forwarder
from tests.helpers.loopback import Command, dropbear, openssh, serve

pytestmark = pytest.mark.emulated

RECONNECT_TIMEOUT_S = 5.0
GIVE_UP_S = RECONNECT_TIMEOUT_S + CONNECT_S
QUICK = Timing(connect_s=5.0)
TOPOLOGY = Topology.MASTER


@contextmanager
def on_loopback(folder: Path, command: Command) -> Iterator[Subject]:
    with serve(folder, command) as server, Forwarder({"robot": server.connect}) as links:
        shell = server.shell(connect=partial(links.reach, "robot"), reconnect_timeout_s=1.0, timing=QUICK)
        yield Subject(
            shell, partial(links.cut, "robot"), partial(links.restore, "robot"), give_up_s=1.0 + QUICK.connect_s
        )
        shell.close()


class TestOpenSsh(ShellConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def subject(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
        with on_loopback(tmp_path_factory.mktemp("openssh"), openssh) as subject:
            yield subject


class TestDropbear(ShellConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def subject(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
        with on_loopback(tmp_path_factory.mktemp("dropbear"), dropbear) as subject:
            yield subject


@contextmanager
def emulated(folder: Path, control: str) -> Iterator[tuple[Cast, EmulatedTestbed]]:
    site = folder / "fieldkit.yaml"
    text = DEFAULT_SITE.read_text(encoding="utf-8")
    options = "{ros: builtin, record_air: true, radio: {fading: false}}"
    extra_keys = f"control: {control}\npatience: {RECONNECT_TIMEOUT_S:g}s\nemulated: {options}\n"
    site.write_text(text + extra_keys, encoding="utf-8")
    backend = EmulatedBackend(*load_site(site))
    cast = backend.cast(TOPOLOGY)
    with backend.open(cast, seed=1, sink=lambda _: None, operator=Unattended()) as testbed:
        assert isinstance(testbed, EmulatedTestbed)
        testbed.place(Placement(Scenario.LOS, TOPOLOGY, parse_distance("5m")))
        yield cast, testbed


def rebooting(testbed: Testbed) -> Callable[[], object]:
    return partial(testbed.inject, Fault(FaultKind.REBOOT, Role.SENDER))


class OfTestbed(ShellConformance, BackendConformance, RebootConformance):
    """All suites, on the testbed of the fixture `opened`."""

    @pytest.fixture(scope="class")
    @classmethod
    def cast(cls, opened: tuple[Cast, Testbed]) -> Cast:
        return opened[0]

    @pytest.fixture(scope="class")
    @classmethod
    def testbed(cls, opened: tuple[Cast, Testbed]) -> Testbed:
        return opened[1]

    @pytest.fixture
    def topology(self) -> Topology:
        return TOPOLOGY


class TestEmulated(OfTestbed):
    @pytest.fixture(scope="class")
    @classmethod
    def opened(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Cast, Testbed]]:
        with emulated(tmp_path_factory.mktemp("separate"), "separate") as opened:
            yield opened

    @pytest.fixture(scope="class")
    @classmethod
    def subject(cls, opened: tuple[Cast, EmulatedTestbed]) -> Subject:
        testbed = opened[1]
        robot = testbed.robots[Role.SENDER]

        def loopback(state: str) -> None:
            inside = ("nsenter", "--target", str(robot.pid), "--net")
            subprocess.run((*inside, "ip", "link", "set", "lo", state), check=True)

        return Subject(testbed.shells[Role.SENDER], partial(loopback, "down"), partial(loopback, "up"), GIVE_UP_S)

    @pytest.fixture
    def reboot(self, testbed: Testbed) -> Callable[[], object]:
        return rebooting(testbed)


class TestEmulatedOverTheRadio(OfTestbed):
    @pytest.fixture(scope="class")
    @classmethod
    def opened(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Cast, Testbed]]:
        with emulated(tmp_path_factory.mktemp("radio"), "radio") as opened:
            yield opened

    @pytest.fixture(scope="class")
    @classmethod
    def subject(cls, opened: tuple[Cast, EmulatedTestbed]) -> Subject:
        testbed = opened[1]
        robot = testbed.robots[Role.SENDER]
        return Subject(testbed.shells[Role.SENDER], robot.switch_off, robot.switch_on, GIVE_UP_S)

    @pytest.fixture
    def reboot(self, testbed: Testbed) -> Callable[[], object]:
        return rebooting(testbed)


class TestField(OfTestbed):
    @pytest.fixture(scope="class")
    @classmethod
    def field_robots(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FieldRobots]:
        with start_field_robots(tmp_path_factory.mktemp("field"), topology=TOPOLOGY) as field_robots:
            yield field_robots

    @pytest.fixture(scope="class")
    @classmethod
    def opened(cls, field_robots: FieldRobots) -> Iterator[tuple[Cast, Testbed]]:
        site = field_robots.folder / "fieldkit.yaml"
        site.write_text(f"patience: {RECONNECT_TIMEOUT_S:g}s\n{site.read_text(encoding='utf-8')}", encoding="utf-8")
        backend = load_backend("field", *load_site(site))
        cast = backend.cast(TOPOLOGY)
        with backend.open(cast, seed=1, sink=lambda _: None, operator=Unattended()) as testbed:
            yield cast, testbed

    @pytest.fixture(scope="class")
    @classmethod
    def subject(cls, field_robots: FieldRobots, opened: tuple[Cast, Testbed]) -> Subject:
        cut, restore = (partial(act, Role.SENDER) for act in (field_robots.links.cut, field_robots.links.restore))
        return Subject(opened[1].shells[Role.SENDER], cut, restore, GIVE_UP_S)

    @pytest.fixture
    def reboot(self, field_robots: FieldRobots) -> Callable[[], object]:
        return rebooting(field_robots.testbed)

"""A radio that is off relays nothing: without the access point, all links are down; other links continue."""

import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from benchmarks.namespaces import Namespace
from fieldkit.config.profiles import Radio
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Fault, FaultKind, Placement, Role, Scenario, Topology, Vector
from fieldkit.core.units import parse_distance
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.faults import inject_until_exit
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

RADIO = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)
ADDRESSES = {"a": "10.9.0.1", "b": "10.9.0.2", "r": "10.9.0.3"}
PLACES: dict[str, Vector] = {"a": (0.0, 0.0, 0.0), "b": (9.0, 0.0, 0.0), "r": (4.5, 0.0, 0.0)}

CLEAR = RadioOptions(fading=False)
OPTIONS = {"wifi": CLEAR, "fixed": RadioOptions.model_validate({"loss": "0%"})}

Bench = tuple[MediumClient, dict[str, Namespace]]


@contextmanager
def make_bench(options: RadioOptions) -> Iterator[Bench]:
    """Yield three namespaces a, b, r on a medium."""
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(options, seed=1))
        namespaces = {name: stack.enter_context(Namespace()) for name in ADDRESSES}
        for name, namespace in namespaces.items():
            fd = namespace.tun("wlan0", f"{ADDRESSES[name]}/24")
            medium.attach(name, f"{ADDRESSES[name]}/24", RADIO, fd)
            os.close(fd)
        yield medium, namespaces


@pytest.fixture(scope="module", params=[*OPTIONS.values()], ids=[*OPTIONS])
def module_bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    with make_bench(request.param) as bench:
        yield bench


@pytest.fixture
def bench(module_bench: Bench) -> Iterator[Bench]:
    """A bench that all tests of a module share; a test may set interfaces down, but not delete them."""
    yield module_bench
    for namespace in module_bench[1].values():
        namespace.ip("link", "set", "wlan0", "up")


def count_replies(namespace: Namespace, address: str, *, within_s: float | None = None) -> int:
    """Return the number of replies to five pings; without a limit, wait for five replies to any number of pings."""
    # After the first reply, ping waits for the last one for only an interval, unless it has a deadline.
    limit = ("-w", "30") if within_s is None else ("-W", f"{within_s:g}")
    output = namespace.run("ping", "-n", "-i", "0.01", *limit, "-c", "5", address, timeout_s=60).stdout
    match = re.search(r"(\d+) received", output)
    return int(match[1]) if match else 0


def set_down(namespace: Namespace) -> None:
    namespace.ip("link", "set", "wlan0", "down")


def test_no_packets_are_relayed_without_the_access_point(bench: Bench) -> None:
    medium, namespaces = bench
    medium.place(PLACES, relay="r")
    assert count_replies(namespaces["a"], ADDRESSES["b"]) == 5
    set_down(namespaces["r"])
    assert count_replies(namespaces["a"], ADDRESSES["b"], within_s=0.3) == 0


def test_direct_links_continue_when_one_station_is_off(bench: Bench) -> None:
    medium, namespaces = bench
    medium.place(PLACES)
    set_down(namespaces["r"])
    assert count_replies(namespaces["a"], ADDRESSES["b"]) == 5
    assert count_replies(namespaces["a"], ADDRESSES["r"], within_s=0.3) == 0


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_a_deleted_interface_relays_nothing_and_direct_links_continue(options: RadioOptions) -> None:
    with make_bench(options) as (medium, namespaces):
        medium.place(PLACES, relay="r")
        assert count_replies(namespaces["a"], ADDRESSES["b"]) == 5
        namespaces["r"].ip("link", "delete", "wlan0")
        assert count_replies(namespaces["a"], ADDRESSES["b"], within_s=0.3) == 0
        medium.place(PLACES)
        assert count_replies(namespaces["a"], ADDRESSES["b"]) == 5
        assert count_replies(namespaces["a"], ADDRESSES["r"], within_s=0.3) == 0


def test_a_station_that_is_off_does_not_affect_others_in_topology_master(bench: Bench) -> None:
    medium, namespaces = bench
    medium.place(PLACES, relay="r")
    set_down(namespaces["b"])
    assert count_replies(namespaces["a"], ADDRESSES["r"]) == 5


def test_an_access_point_that_is_on_again_relays_again(bench: Bench) -> None:
    medium, namespaces = bench
    medium.place(PLACES, relay="r")
    set_down(namespaces["r"])
    assert count_replies(namespaces["a"], ADDRESSES["b"], within_s=0.3) == 0
    namespaces["r"].ip("link", "set", "wlan0", "up")
    assert count_replies(namespaces["a"], ADDRESSES["b"]) == 5


def test_a_station_that_is_off_during_placement_works_once_it_is_up(bench: Bench) -> None:
    medium, namespaces = bench
    set_down(namespaces["r"])
    medium.place(PLACES, relay="r")
    assert count_replies(namespaces["a"], ADDRESSES["b"], within_s=0.3) == 0
    namespaces["r"].ip("link", "set", "wlan0", "up")
    assert count_replies(namespaces["a"], ADDRESSES["b"]) == 5


@pytest.fixture(scope="module")
def robots() -> Iterator[EmulatedTestbed]:
    """Three robots; while all are up, each is in range of the others."""
    cast = EmulatedBackend(None, None).cast(Topology.MASTER)
    with testbed.bring_up(
        cast,
        options=EmulatedOptions.model_validate({"radio": CLEAR, "boot": "0.1s"}),
        world=load_world("lawn"),
        ros=RosChoice.BUILTIN,
        seed=1,
    ) as emulation:
        yield emulation


FAULTS = [
    Fault(FaultKind.LINK_DOWN, Role.RELAY, 1.5),
    Fault(FaultKind.OUT_OF_RANGE, Role.RELAY, 1.5),
    Fault(FaultKind.REBOOT, Role.RELAY),
]


@pytest.mark.parametrize("topology", Topology)
@pytest.mark.parametrize("fault", FAULTS, ids=[str(fault.kind) for fault in FAULTS])
def test_a_fault_of_the_relay_interrupts_only_topology_master(
    robots: EmulatedTestbed, topology: Topology, fault: Fault
) -> None:
    robots.place(Placement(Scenario.LOS, topology, parse_distance("5m")))
    assert is_reachable(robots)
    with inject_until_exit(robots, fault):
        if topology is Topology.MASTER:
            wait_until(lambda: not is_reachable(robots, within_s=0.3), Deadline.after(60))
        else:
            assert is_reachable(robots)
    assert is_reachable(robots), "the fault has ended"


def test_an_access_point_relays_even_if_its_programs_are_killed(robots: EmulatedTestbed) -> None:
    robots.inject(Fault(FaultKind.KILL, Role.RELAY, process="sshd"))
    for topology in Topology:
        robots.place(Placement(Scenario.LOS, topology, parse_distance("5m")))
        assert is_reachable(robots)


def is_reachable(robots: EmulatedTestbed, *, within_s: float = 10.0) -> bool:
    """Return True if the sender receives a ping reply from the receiver over the radio."""
    argv = ("ping", "-n", "-c", "1", "-W", f"{within_s:g}", robots.robots[Role.RECEIVER].spec.ip)
    return robots.shells[Role.SENDER].run(argv, deadline=Deadline.after(60), check=False).exit_code == 0

"""A radio that is off relays nothing: a dead access point silences everyone, without one the others go on."""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack

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
from sim_backends.radio.options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.faults import inject_until_exit
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

RADIO = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)
ADDRESSES = {"a": "10.9.0.1", "b": "10.9.0.2", "r": "10.9.0.3"}
PLACES: dict[str, Vector] = {"a": (0.0, 0.0, 0.0), "b": (9.0, 0.0, 0.0), "r": (4.5, 0.0, 0.0)}

CLEAR = RadioOptions(fading=False)

Bench = tuple[MediumClient, dict[str, Namespace]]


@pytest.fixture(params=[CLEAR, RadioOptions.model_validate({"loss": "0%"})], ids=["wifi", "fixed"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Three namespaces a, b, r on a medium."""
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(request.param, seed=1))
        spaces = {name: stack.enter_context(Namespace()) for name in ADDRESSES}
        for name, space in spaces.items():
            fd = space.tun("wlan0", f"{ADDRESSES[name]}/24")
            medium.attach(name, f"{ADDRESSES[name]}/24", RADIO, fd)
            os.close(fd)
        yield medium, spaces


def answers(space: Namespace, address: str, *, within_s: float = 10.0) -> int:
    """Return how many of five pings are answered."""
    said = space.run("ping", "-n", "-i", "0.01", "-W", f"{within_s:g}", "-c", "5", address, timeout_s=60).stdout
    found = re.search(r"(\d+) received", said)
    return int(found[1]) if found else 0


def down(space: Namespace) -> None:
    space.ip("link", "set", "wlan0", "down")


def deleted(space: Namespace) -> None:
    space.ip("link", "delete", "wlan0")


@pytest.mark.parametrize("end", [down, deleted])
def test_a_dead_access_point_silences_everyone(bench: Bench, end: Callable[[Namespace], None]) -> None:
    medium, spaces = bench
    medium.place(PLACES, relay="r")
    assert answers(spaces["a"], ADDRESSES["b"]) == 5
    end(spaces["r"])
    assert answers(spaces["a"], ADDRESSES["b"], within_s=0.3) == 0


@pytest.mark.parametrize("end", [down, deleted])
def test_without_an_access_point_the_others_go_on(bench: Bench, end: Callable[[Namespace], None]) -> None:
    medium, spaces = bench
    medium.place(PLACES)
    end(spaces["r"])
    assert answers(spaces["a"], ADDRESSES["b"]) == 5
    assert answers(spaces["a"], ADDRESSES["r"], within_s=0.3) == 0


def test_in_master_a_dead_station_leaves_the_others_alone(bench: Bench) -> None:
    medium, spaces = bench
    medium.place(PLACES, relay="r")
    down(spaces["b"])
    assert answers(spaces["a"], ADDRESSES["r"]) == 5


def test_an_access_point_that_is_back_relays_again(bench: Bench) -> None:
    medium, spaces = bench
    medium.place(PLACES, relay="r")
    down(spaces["r"])
    assert answers(spaces["a"], ADDRESSES["b"], within_s=0.3) == 0
    spaces["r"].ip("link", "set", "wlan0", "up")
    assert answers(spaces["a"], ADDRESSES["b"]) == 5


def test_who_is_off_when_all_are_placed_is_on_the_air_once_it_is_up(bench: Bench) -> None:
    medium, spaces = bench
    down(spaces["r"])
    medium.place(PLACES, relay="r")
    assert answers(spaces["a"], ADDRESSES["b"], within_s=0.3) == 0
    spaces["r"].ip("link", "set", "wlan0", "up")
    assert answers(spaces["a"], ADDRESSES["b"]) == 5


@pytest.fixture(scope="module")
def up() -> Iterator[EmulatedTestbed]:
    """Three robots; as long as all are up, each is in range of the others."""
    cast = EmulatedBackend(None, None).cast(Topology.MASTER)
    with testbed.bring_up(
        cast,
        options=EmulatedOptions.model_validate({"radio": CLEAR, "boot": "0.1s"}),
        world=load_world("lawn"),
        ros=RosChoice.BUILTIN,
        seed=1,
    ) as robots:
        yield robots


FAULTS = [
    Fault(FaultKind.LINK_DOWN, Role.RELAY, 1.5),
    Fault(FaultKind.OUT_OF_RANGE, Role.RELAY, 1.5),
    Fault(FaultKind.REBOOT, Role.RELAY),
]


@pytest.mark.parametrize("topology", Topology)
@pytest.mark.parametrize("fault", FAULTS, ids=[str(fault.kind) for fault in FAULTS])
def test_a_fault_of_the_relay_silences_the_stations_in_master_alone(
    up: EmulatedTestbed, topology: Topology, fault: Fault
) -> None:
    up.place(Placement(Scenario.LOS, topology, parse_distance("5m")))
    assert hears(up)
    with inject_until_exit(up, fault):
        if topology is Topology.MASTER:
            wait_until(lambda: not hears(up, within_s=0.3), Deadline.after(60))
        else:
            assert hears(up)
    assert hears(up), "it is over"


def test_an_access_point_relays_whatever_becomes_of_its_programs(up: EmulatedTestbed) -> None:
    up.inject(Fault(FaultKind.KILL, Role.RELAY, process="sshd"))
    for topology in Topology:
        up.place(Placement(Scenario.LOS, topology, parse_distance("5m")))
        assert hears(up)


def hears(up: EmulatedTestbed, *, within_s: float = 10.0) -> bool:
    """Return whether the sender gets an answer from the receiver over the radio."""
    argv = ("ping", "-n", "-c", "1", "-W", f"{within_s:g}", up.robots[Role.RECEIVER].spec.ip)
    return up.shells[Role.SENDER].run(argv, deadline=Deadline.after(60), check=False).exit_code == 0

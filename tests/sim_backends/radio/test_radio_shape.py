"""The shape of the paper's field trial on a virtual clock: what distance, wall and relay do on the lawn, unfitted."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Final

import numpy as np
import pytest

from fieldkit.core.model import Placement, Scenario, Topology
from fieldkit.core.units import parse_distance
from sim_backends.emulated import placement
from sim_backends.radio.model import WifiInWorld
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.world_channel import antenna_of
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST

FRAGMENTS: Final[Mapping[int, int]] = dict(enumerate((1500, 1500, 1500, 1500, 1500, 820)))
"""IP packets of a datagram of 8,192 bytes, as netcat sends it, with their sizes in bytes."""
DATAGRAMS: Final = 400
EVERY_NS: Final = 1_000_000_000
"""From one datagram to the next: longer than a fade lasts, so that each meets another."""
AGAIN_NS: Final = 250_000_000
"""From a transmission to the next of what was lost: TCP's timeout is 200 ms at least, and a round trip."""
TIMES: Final = 4

SENDER, RECEIVER = "turtlebot-1", "turtlebot-2"


@dataclass(frozen=True)
class Outcome:
    """What became of datagrams that were sent one by one.

    Attributes:
        packets: Share of IP packets lost when sent once, as UDP does.
        datagrams: Share of datagrams that lost one of them.
        repaired: Share of IP packets lost when what is missing is sent up to four times, as TCP does.
        delay_s: Median time until the last packet of a whole datagram arrived.
    """

    packets: float
    datagrams: float
    repaired: float
    delay_s: float


@cache
def trial(scenario: Scenario, topology: Topology, distance: str, *, fading: bool = True) -> Outcome:
    world, where = load_world("lawn"), Placement(scenario, topology, parse_distance(distance))
    antennas = {robot.name: antenna_of(robot.profile.radio) for robot in CAST.values()}
    model: WifiInWorld[int] = WifiInWorld(1, RadioOptions(fading=fading), antennas, world)
    model.place(0, placement.positions_m(CAST, where, world), placement.relay(CAST, where))
    once, again, delays_ns = [], [], []
    for number in range(DATAGRAMS):
        start_ns = number * EVERY_NS * TIMES
        missing = set(FRAGMENTS)
        for attempt in range(TIMES):
            arrived_ns = send(model, start_ns + attempt * AGAIN_NS, missing)
            missing -= arrived_ns.keys()
            if not attempt:
                once.append(len(missing))
                if not missing:
                    delays_ns.append(max(arrived_ns.values()) - start_ns)
        again.append(len(missing))
    packets = DATAGRAMS * len(FRAGMENTS)
    return Outcome(
        packets=sum(once) / packets,
        datagrams=sum(map(bool, once)) / DATAGRAMS,
        repaired=sum(again) / packets,
        delay_s=float(np.median(delays_ns)) / 1e9,
    )


def send(model: WifiInWorld[int], now_ns: int, fragments: set[int]) -> dict[int, int]:
    """Send fragments together; return when those arrived that did, in ns, once nothing is under way any more."""
    for number in sorted(fragments):
        model.send(now_ns, SENDER, number, FRAGMENTS[number], RECEIVER)
    arrived_ns: dict[int, int] = {}
    while (event_ns := model.next_event_ns()) is not None:
        arrived_ns |= {number: at_ns for at_ns, _, number, _, _ in model.deliveries(event_ns)}
    return arrived_ns


@pytest.mark.parametrize(
    ("topology", "distances"),
    [(Topology.MASTER, ("5ft", "20ft", "30ft")), (Topology.MASTERLESS, ("10ft", "30ft", "55ft"))],
)
def test_behind_the_wall_loss_grows_with_distance_and_datagrams_lose_more_than_packets(
    topology: Topology, distances: tuple[str, ...]
) -> None:
    outcomes = [trial(Scenario.NLOS, topology, distance) for distance in distances]
    assert all(near.packets < far.packets for near, far in pairwise(outcomes))
    far = outcomes[-1]
    assert far.packets < far.datagrams < 6 * far.packets


@pytest.mark.parametrize(("topology", "distance"), [(Topology.MASTER, "30ft"), (Topology.MASTERLESS, "55ft")])
def test_the_wall_costs_packets(topology: Topology, distance: str) -> None:
    sight, wall = (trial(scenario, topology, distance).packets for scenario in (Scenario.LOS, Scenario.NLOS))
    assert wall > sight + 0.001


@pytest.mark.parametrize("scenario", Scenario)
@pytest.mark.parametrize(("topology", "distance"), [(Topology.MASTER, "30ft"), (Topology.MASTERLESS, "55ft")])
def test_what_is_sent_again_loses_less_than_one_in_a_hundred(
    scenario: Scenario, topology: Topology, distance: str
) -> None:
    assert trial(scenario, topology, distance).repaired < 0.01


@pytest.mark.parametrize("distance", ["10ft", "30ft"])
def test_the_access_point_costs_one_hop_more(distance: str) -> None:
    direct, relayed = (trial(Scenario.LOS, topology, distance).delay_s for topology in reversed(Topology))
    assert 1.7 < relayed / direct < 2.3


def test_without_fading_nothing_is_lost_at_the_paper_s_distances() -> None:
    for scenario in Scenario:
        assert trial(scenario, Topology.MASTERLESS, "55ft", fading=False).packets == 0


@pytest.mark.parametrize(("topology", "distance"), [(Topology.MASTER, "30ft"), (Topology.MASTERLESS, "55ft")])
def test_nowhere_on_the_paper_s_lawn_a_third_is_lost(topology: Topology, distance: str) -> None:
    assert trial(Scenario.NLOS, topology, distance).datagrams < 1 / 3

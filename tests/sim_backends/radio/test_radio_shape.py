"""The field trial of the paper in virtual time: effects of distance, wall and relay on the lawn, without fitting."""

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
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST

FRAGMENTS: Final[Mapping[int, int]] = dict(enumerate((1500, 1500, 1500, 1500, 1500, 820)))
"""IP packets of a datagram of 8,192 bytes, as netcat sends it, with their sizes in bytes."""
DATAGRAMS: Final = 400
INTERVAL_NS: Final = 1_000_000_000
"""Interval of datagrams: longer than a fade, so that each datagram has a different fade."""
RETRANSMIT_NS: Final = 250_000_000
"""Interval of retransmissions: TCP's timeout is at least 200 ms plus a round trip."""
MAX_TRANSMISSIONS: Final = 4

SENDER, RECEIVER = "turtlebot-1", "turtlebot-2"


@dataclass(frozen=True)
class Outcome:
    """Results of datagrams that were sent separately.

    Attributes:
        packet_loss: Share of IP packets lost with a single transmission, as in UDP.
        datagram_loss: Share of datagrams with at least one lost packet.
        loss_after_retransmission: Share of IP packets lost although they were sent up to four times, as in TCP.
        delay_s: Median time until the last packet of a complete datagram arrived.
    """

    packet_loss: float
    datagram_loss: float
    loss_after_retransmission: float
    delay_s: float


@cache
def trial(scenario: Scenario, topology: Topology, distance: str, *, fading: bool = True) -> Outcome:
    world, robot_placement = load_world("lawn"), Placement(scenario, topology, parse_distance(distance))
    antennas = {robot.name: antenna_of(robot.profile.radio) for robot in CAST.values()}
    model: WifiInWorld[int] = WifiInWorld(1, RadioOptions(fading=fading), antennas, world)
    model.place(0, placement.positions_m(CAST, robot_placement, world), placement.relay(CAST, robot_placement))
    missing_counts_after_one, missing_counts_after_all, delays_ns = [], [], []
    for number in range(DATAGRAMS):
        start_ns = number * INTERVAL_NS * MAX_TRANSMISSIONS
        missing_fragments = set(FRAGMENTS)
        for attempt in range(MAX_TRANSMISSIONS):
            arrived_ns = send(model, start_ns + attempt * RETRANSMIT_NS, missing_fragments)
            missing_fragments -= arrived_ns.keys()
            if not attempt:
                missing_counts_after_one.append(len(missing_fragments))
                if not missing_fragments:
                    delays_ns.append(max(arrived_ns.values()) - start_ns)
        missing_counts_after_all.append(len(missing_fragments))
    packets = DATAGRAMS * len(FRAGMENTS)
    return Outcome(
        packet_loss=sum(missing_counts_after_one) / packets,
        datagram_loss=sum(map(bool, missing_counts_after_one)) / DATAGRAMS,
        loss_after_retransmission=sum(missing_counts_after_all) / packets,
        delay_s=float(np.median(delays_ns)) / 1e9,
    )


def send(model: WifiInWorld[int], now_ns: int, fragments: set[int]) -> dict[int, int]:
    """Send fragments together; return the arrival times in ns of those that arrived."""
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
def test_behind_the_wall_loss_grows_with_distance_and_is_higher_for_datagrams_than_for_packets(
    topology: Topology, distances: tuple[str, ...]
) -> None:
    outcomes = [trial(Scenario.NLOS, topology, distance) for distance in distances]
    assert all(nearer.packet_loss < farther.packet_loss for nearer, farther in pairwise(outcomes))
    farthest = outcomes[-1]
    assert farthest.packet_loss < farthest.datagram_loss < 6 * farthest.packet_loss


@pytest.mark.parametrize(("topology", "distance"), [(Topology.MASTER, "30ft"), (Topology.MASTERLESS, "55ft")])
def test_the_wall_increases_the_loss(topology: Topology, distance: str) -> None:
    los_loss, nlos_loss = (
        trial(scenario, topology, distance).packet_loss for scenario in (Scenario.LOS, Scenario.NLOS)
    )
    assert nlos_loss > los_loss + 0.001


@pytest.mark.parametrize("scenario", Scenario)
@pytest.mark.parametrize(("topology", "distance"), [(Topology.MASTER, "30ft"), (Topology.MASTERLESS, "55ft")])
def test_retransmission_reduces_the_loss_below_one_percent(
    scenario: Scenario, topology: Topology, distance: str
) -> None:
    assert trial(scenario, topology, distance).loss_after_retransmission < 0.01


@pytest.mark.parametrize("distance", ["10ft", "30ft"])
def test_the_access_point_adds_one_hop_of_delay(distance: str) -> None:
    direct_delay_s, relayed_delay_s = (
        trial(Scenario.LOS, topology, distance).delay_s for topology in reversed(Topology)
    )
    assert 1.7 < relayed_delay_s / direct_delay_s < 2.3


def test_without_fading_no_packet_is_lost_at_the_distances_of_the_paper() -> None:
    for scenario in Scenario:
        assert trial(scenario, Topology.MASTERLESS, "55ft", fading=False).packet_loss == 0


@pytest.mark.parametrize(("topology", "distance"), [(Topology.MASTER, "30ft"), (Topology.MASTERLESS, "55ft")])
def test_on_the_lawn_of_the_paper_less_than_a_third_of_the_datagrams_are_lost(
    topology: Topology, distance: str
) -> None:
    assert trial(Scenario.NLOS, topology, distance).datagram_loss < 1 / 3

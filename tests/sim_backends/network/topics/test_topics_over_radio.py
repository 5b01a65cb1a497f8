"""Publish-subscribe and ROS 1 over the radio, directly and over a relay."""

from functools import partial

import pytest

from sim_backends.network.disturbances import Disturbance, LinkCut
from sim_backends.network.packets import Packet
from sim_backends.network.ros1.options import Ros1Flow
from sim_backends.network.ros1.transport import Ros1
from sim_backends.network.topics.qos import Qos, TopicFlow
from sim_backends.network.topics.transport import Topics
from tests.helpers.radio_networks import MS, Outcome, network, outcome, standing, wifi

NAMES = ("ugv", "uav", "other")
STATES = standing({"ugv": (0.0, 0.0, 1.0), "uav": (20.0, 0.0, 5.0), "other": (10.0, 20.0, 1.0)})
PERIOD_NS, COUNT = 20 * MS, 150


def carried(protocol: str, *, relay: str | None = None, disturbances: tuple[Disturbance, ...] = ()) -> Outcome:
    """Return what becomes of messages of 3 s from ugv to other, of which each takes two frames."""
    topic = TopicFlow("ugv", "other", Qos(history="keep_all"))
    net = network(
        wifi(NAMES),
        NAMES,
        transports={
            "topic": partial(Topics, flows={"state": topic}),
            "ros1": partial(Ros1, flows={"state": Ros1Flow("ugv", "other")}, master="uav"),
        },
        disturbances=disturbances,
        relay=relay,
    )
    times_ns = [number * PERIOD_NS for number in range(COUNT)]
    sent = [
        Packet(number, "ugv", "other", 2000, ("state", number), at_ns, at_ns, protocol)
        for number, at_ns in enumerate(times_ns)
    ]
    return outcome(sent, *net.advance(5000 * MS, sent, STATES))


@pytest.mark.parametrize("relay", [None, "uav"])
@pytest.mark.parametrize("protocol", ["topic", "ros1"])
def test_all_arrives_once_the_ends_have_found_each_other(protocol: str, relay: str | None) -> None:
    one = carried(protocol, relay=relay)
    before = len(one.dropped)
    assert set(one.dropped.values()) <= {"not matched yet", "no subscriber is connected"}
    assert 0 < before < 20
    assert [number for _, number in one.arrived] == list(range(before, COUNT))
    assert one == carried(protocol, relay=relay), "twice the same"


@pytest.mark.parametrize("protocol", ["topic", "ros1"])
def test_what_a_short_outage_stops_comes_after_it(protocol: str) -> None:
    cut = LinkCut("ugv", "other", 1000 * MS, 2000 * MS)
    one = carried(protocol, disturbances=(cut,))
    assert len(one.arrived) + len(one.dropped) == COUNT
    assert not any(1010 * MS < at_ns <= 2000 * MS for at_ns in one.arrived.values())
    assert max(one.dropped)[1] < 50

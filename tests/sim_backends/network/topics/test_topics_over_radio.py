"""Publish-subscribe and ROS 1 over the radio, directly and over a relay."""

from functools import partial

import pytest

from sim_backends.network.disturbances import Disturbance, LinkCut
from sim_backends.network.packets import Packet
from sim_backends.network.ros1.ros1_options import Ros1Flow
from sim_backends.network.ros1.ros1_transport import Ros1
from sim_backends.network.topics.qos import Qos, TopicFlow
from sim_backends.network.topics.rtps_transport import Topics
from tests.helpers.radio_networks import MS, Outcome, network, outcome, standing, wifi

NAMES = ("ugv", "uav", "other")
STATES = standing({"ugv": (0.0, 0.0, 1.0), "uav": (20.0, 0.0, 5.0), "other": (10.0, 20.0, 1.0)})
PERIOD_NS, COUNT = 20 * MS, 150


def run_messages(protocol: str, *, relay: str | None = None, disturbances: tuple[Disturbance, ...] = ()) -> Outcome:
    """Return the results of messages over 3 s from ugv to other; each message takes two frames."""
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
    sent_packets = [
        Packet(number, "ugv", "other", 2000, ("state", number), at_ns, at_ns, protocol)
        for number, at_ns in enumerate(times_ns)
    ]
    return outcome(sent_packets, *net.advance(5000 * MS, sent_packets, STATES))


@pytest.mark.parametrize("relay", [None, "uav"])
@pytest.mark.parametrize("protocol", ["topic", "ros1"])
def test_all_messages_arrive_after_matching(protocol: str, relay: str | None) -> None:
    result = run_messages(protocol, relay=relay)
    dropped_count = len(result.dropped)
    assert set(result.dropped.values()) <= {"not matched yet", "no subscriber is connected"}
    assert 0 < dropped_count < 20
    assert [number for _, number in result.arrived] == list(range(dropped_count, COUNT))
    assert result == run_messages(protocol, relay=relay), "runs are reproducible"


@pytest.mark.parametrize("protocol", ["topic", "ros1"])
def test_messages_delayed_by_a_short_outage_arrive_after_it(protocol: str) -> None:
    link_cut = LinkCut("ugv", "other", 1000 * MS, 2000 * MS)
    result = run_messages(protocol, disturbances=(link_cut,))
    assert len(result.arrived) + len(result.dropped) == COUNT
    assert not any(1010 * MS < at_ns <= 2000 * MS for at_ns in result.arrived.values())
    assert max(result.dropped)[1] < 50

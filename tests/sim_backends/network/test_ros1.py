"""ROS 1 over a scripted link: the hosts that must be reachable to establish and to keep a connection."""

from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Packet
from sim_backends.network.ros1.ros1_options import Ros1Flow, Ros1Options
from sim_backends.network.ros1.ros1_transport import Ros1
from sim_backends.network.ros1.streams import CallRetry
from sim_backends.network.tcp.tcp_options import TcpOptions
from sim_backends.network.wire import IpPacket
from sim_backends.radio.core.random_streams import PacketDraws
from tests.helpers.scripted_wire import Script, ScriptedWire

MS = 1_000_000
SECOND = 1000 * MS
DELAY_NS = MS
TCPROS = Ros1Flow("a", "b")
UDPROS = Ros1Flow("a", "b", "udpros")
NOT_CONNECTED = "no subscriber is connected"


def make_wire(
    flow: Ros1Flow, script: Script | None = None, *, master: str = "m", options: Ros1Options | None = None
) -> ScriptedWire:
    """Return a wire on which a publishes to b, with a master."""
    wire = ScriptedWire(DELAY_NS, script=script, hosts=("a", "b", "m"))
    wire.transports["ros1"] = Ros1(wire, {"scan": flow}, master=master, options=options)
    return wire


def publish(wire: ScriptedWire, times_ns: Sequence[int], size_bytes: int = 1492) -> None:
    """Publish messages at these times; a LaserScan of 360 beams has 1,492 bytes."""
    for number, at_ns in enumerate(times_ns):
        wire.send_at(at_ns, Packet(number, "a", "b", size_bytes, ("scan", number), at_ns, at_ns, "ros1"))


def losing_between(begin_ns: int, end_ns: int, *hosts: str) -> tuple[Script, list[ScriptedWire]]:
    """Return a script that loses packets between these hosts in this time, and a list for its wire."""
    wires: list[ScriptedWire] = []

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return () if begin_ns <= wires[0].now_ns < end_ns and {packet.source, receiver} <= {*hosts} else (0,)

    return script, wires


def test_a_connection_is_established_as_fast_as_with_rospy() -> None:
    """Captured from rosmaster and rospy 1.15.15: 12 delays, in addition to the handshake with the master."""
    wire = make_wire(TCPROS)
    # A handshake with the master, call and response; the same with the publisher; another call to the master; and a
    # handshake and the subscriber's header.
    connected_ns = (4 + 4 + 2 + 3) * DELAY_NS
    publish(wire, [0, connected_ns - 1, connected_ns + 1, connected_ns + 10 * DELAY_NS])
    wire.run(SECOND)
    assert wire.dropped == dict.fromkeys((0, 1), NOT_CONNECTED)
    assert wire.delivered == {2: connected_ns + 1 + DELAY_NS, 3: connected_ns + 11 * DELAY_NS}


def test_only_the_first_connection_of_a_subscriber_queries_the_keep_alive_setting() -> None:
    wire = ScriptedWire(DELAY_NS, hosts=("a", "b", "m"))
    wire.transports["ros1"] = Ros1(
        wire, {"scan": TCPROS, "late": Ros1Flow("m", "b")}, master="m", options=Ros1Options(starts_ns={"m": SECOND})
    )
    wire.run(2 * SECOND)
    requests = [transmission for transmission in wire.transmitted if transmission.packet.size_bytes == 52 + 370]
    assert len(requests) == 1
    assert requests[0].at_ns < SECOND


def test_a_response_uses_the_connection_of_its_call() -> None:
    wire = make_wire(TCPROS)
    wire.run(SECOND)
    syns = [
        transmission.packet
        for transmission in wire.transmitted
        if transmission.packet.size_bytes == 60 and transmission.packet.identity[0].endswith(" syn 0")
    ]
    connections = Counter((packet.source, packet.destination) for packet in syns)
    assert connections == {("a", "m"): 1, ("b", "m"): 1, ("b", "a"): 2}


def test_udpros_is_connected_by_the_call_to_the_publisher() -> None:
    wire = make_wire(UDPROS)
    connected_ns = (4 + 3) * DELAY_NS
    publish(wire, [connected_ns - 1, connected_ns + 1])
    wire.run(SECOND)
    assert wire.dropped == {0: NOT_CONNECTED}
    assert wire.delivered == {1: connected_ns + 1 + DELAY_NS}


def test_the_master_reports_a_publisher_that_starts_later() -> None:
    wire = make_wire(TCPROS, options=Ros1Options(starts_ns={"a": 5 * SECOND}))
    # The publisher's call, the master's call, the subscriber's calls to the publisher and to the master, and the
    # header.
    connected_ns = 5 * SECOND + (3 + 3 + 4 + 2 + 3) * DELAY_NS
    publish(wire, [connected_ns - 1, connected_ns + 1])
    wire.run(10 * SECOND)
    assert (wire.dropped, list(wire.delivered)) == ({0: NOT_CONNECTED}, [1])


@pytest.mark.parametrize("master", ["a", "b"])
def test_the_master_may_be_on_a_robot_that_publishes_or_subscribes(master: str) -> None:
    wire = make_wire(TCPROS, master=master)
    publish(wire, [SECOND])
    wire.run(2 * SECOND)
    assert list(wire.delivered) == [0]


@pytest.mark.parametrize("flow", [TCPROS, UDPROS])
def test_without_the_master_no_connection_is_established(flow: Ros1Flow) -> None:
    """The robots can always reach each other; the first SYN that the master receives is sent at 31 s."""
    script, wires = losing_between(0, 20 * SECOND, "b", "m")
    wire = make_wire(flow, script)
    wires.append(wire)
    publish(wire, [number * SECOND for number in range(40)])
    wire.run(50 * SECOND)
    assert wire.dropped == dict.fromkeys(range(32), NOT_CONNECTED)
    assert list(wire.delivered) == list(range(32, 40))


@pytest.mark.parametrize("flow", [TCPROS, UDPROS])
def test_without_the_master_a_connection_continues(flow: Ros1Flow) -> None:
    script, wires = losing_between(SECOND // 2, 100 * SECOND, "a", "b", "m")
    wire = make_wire(
        flow,
        lambda packet, receiver, number: (
            (0,) if "m" not in {packet.source, receiver} else script(packet, receiver, number)
        ),
    )
    wires.append(wire)
    publish(wire, [number * SECOND for number in range(1, 90)])
    wire.run(100 * SECOND)
    assert len(wire.delivered) == 89


def test_a_call_whose_connection_fails_is_retried() -> None:
    """With one retransmission of its SYN, TCP gives up after 1 s and 2 s more; 50 ms later another call starts."""
    script, wires = losing_between(0, 4 * SECOND, "b", "m")
    wire = make_wire(TCPROS, script, options=Ros1Options(tcp=TcpOptions(syn_retries=1)))
    wires.append(wire)
    wire.run(20 * SECOND)
    syns_ns = [
        transmission.at_ns
        for transmission in wire.transmitted
        if (transmission.packet.source, transmission.packet.destination) == ("b", "m")
    ]
    first_ns = [0, SECOND, 3050 * MS, 4050 * MS]
    assert syns_ns[:4] == first_ns
    publish(wire, [wire.now_ns])
    wire.run(30 * SECOND)
    assert list(wire.delivered) == [0]


def test_a_connection_that_fails_in_tcp_is_opened_again() -> None:
    """The publisher's TCP gives up early; the subscriber probes after a minute without messages, and reconnects."""
    script, wires = losing_between(2 * SECOND, 20 * SECOND, "a", "b")
    wire = make_wire(TCPROS, script, options=Ros1Options(tcp=TcpOptions(retries=3)))
    wires.append(wire)
    publish(wire, [number * SECOND for number in range(1, 100)])
    wire.run(120 * SECOND)
    reasons = Counter(wire.dropped.values())
    # The last message arrived at 1 s, so the probe is sent at 61 s; 100 ms later the connection is opened.
    assert reasons.pop(NOT_CONNECTED) == 61 - 1 - sum(reasons.values())
    assert wire.delivered.keys() == {0, *range(61, 99)}


def test_a_subscriber_without_messages_closes_its_connection_and_reconnects() -> None:
    """Nine probes follow 60 s without messages, at intervals of 10 s; then the publisher has a new connection."""
    script, wires = losing_between(2 * SECOND, 200 * SECOND, "a", "b")
    wire = make_wire(TCPROS, script, options=Ros1Options(tcp=TcpOptions(syn_retries=2)))
    wires.append(wire)
    publish(wire, [SECOND, 100 * SECOND, 250 * SECOND])
    wire.run(260 * SECOND)
    probes_ns = [
        transmission.at_ns for transmission in wire.transmitted if transmission.packet.identity[0] == "scan probe"
    ]
    received_ns = wire.delivered[0]
    assert probes_ns == [received_ns + (60 + 10 * number) * SECOND for number in range(9)]
    # The publisher's TCP retries for longer, on a connection that the subscriber has given up.
    assert wire.dropped == {1: "the subscriber has given up this connection"}
    assert list(wire.delivered) == [0, 2]


def test_an_answered_probe_resets_the_probe_counter() -> None:
    """Eight of nine probes are lost, and later eight again."""
    outages_ns = [(30 * SECOND, 135 * SECOND), (150 * SECOND, 275 * SECOND)]
    wires: list[ScriptedWire] = []

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return () if any(begin <= wires[0].now_ns < end for begin, end in outages_ns) else (0,)

    wire = make_wire(TCPROS, script)
    wires.append(wire)
    publish(wire, [SECOND, 400 * SECOND])
    wire.run(401 * SECOND)
    lost_probes = [
        transmission
        for transmission in wire.transmitted
        if transmission.packet.identity[0] == "scan probe" and not transmission.arrived
    ]
    assert len(lost_probes) == 16
    assert not any("header 2" in transmission.packet.identity[0] for transmission in wire.transmitted)
    assert list(wire.delivered) == [0, 1]


def test_a_subscriber_that_the_master_cannot_reach_never_connects() -> None:
    """The subscriber registered first, and the master does not repeat its call, as in rosmaster."""
    script, wires = losing_between(SECOND, 10 * SECOND, "b", "m")
    options = Ros1Options(tcp=TcpOptions(syn_retries=1), starts_ns={"a": 2 * SECOND})
    wire = make_wire(TCPROS, script, options=options)
    wires.append(wire)
    publish(wire, [100 * SECOND])
    wire.run(101 * SECOND)
    assert wire.dropped == {0: NOT_CONNECTED}


def test_a_call_that_is_executed_twice_opens_one_connection() -> None:
    """The master's responses to the publisher are lost, so that the master calls the subscriber several times."""

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return () if (packet.source, receiver) == ("m", "a") and "back" in packet.identity[0] else (0,)

    wire = make_wire(TCPROS, script, options=Ros1Options(tcp=TcpOptions(retries=2)))
    wire.run(20 * SECOND)
    updates = {
        transmission.packet.identity
        for transmission in wire.transmitted
        if transmission.packet.identity[0].startswith("xmlrpc m b 0 data")
    }
    requests = {
        transmission.packet.identity
        for transmission in wire.transmitted
        if transmission.packet.identity[0].startswith("xmlrpc b a scan 0 data")
    }
    assert len(updates) > 3
    assert len(requests) == 1


def test_a_header_without_response_is_sent_again() -> None:
    """The publisher's TCP gives up its header; the subscriber, which waits for it, probes after a minute."""
    wire = make_wire(
        TCPROS,
        lambda packet, *_: () if packet.source == "a" and packet.identity[0].startswith("scan 1 ") else (0,),
        options=Ros1Options(tcp=TcpOptions(syn_retries=1)),
    )
    publish(wire, [70 * SECOND])
    wire.run(80 * SECOND)
    assert list(wire.delivered) == [0]


def test_an_idle_connection_is_probed_and_stays_open() -> None:
    wire = make_wire(TCPROS)
    publish(wire, [SECOND, 600 * SECOND])
    wire.run(601 * SECOND)
    flow_counts = Counter(transmission.packet.identity[0] for transmission in wire.transmitted)
    # Each response counts as a message, so that the next probe follows 60 s after it.
    assert flow_counts["scan probe"] == flow_counts["scan probe answer"] == 9
    assert list(wire.delivered) == [0, 1]


@pytest.mark.parametrize(("size_bytes", "blocks"), [(1488, 1), (1489, 2), (10_000, 7)])
def test_udpros_loses_a_message_if_any_block_is_lost(size_bytes: int, blocks: int) -> None:
    draws = PacketDraws(1, "link")
    loss, count = 0.1, 2000
    wire = make_wire(
        UDPROS,
        lambda packet, *_: (
            (0,) if packet.size_bytes < 100 or wire.now_ns < SECOND or draws.draw(packet.identity) >= loss else ()
        ),
    )
    publish(wire, [(1000 + number) * MS for number in range(count)], size_bytes)
    wire.run(10 * SECOND)
    block_packets = [
        transmission.packet for transmission in wire.transmitted if "block" in transmission.packet.identity[0]
    ]
    assert len(block_packets) == blocks * count
    # Headers of length, UDPROS, UDP and IP.
    assert sum(packet.size_bytes for packet in block_packets) == count * (size_bytes + 4 + blocks * (8 + 8 + 20))
    # The last block of a message may be too short for the script to lose it.
    blocks_subject_to_loss = sum(packet.size_bytes >= 100 for packet in block_packets) / count
    expected = 1 - (1 - loss) ** blocks_subject_to_loss
    assert len(wire.dropped) / count == pytest.approx(expected, abs=4 * (expected * (1 - expected) / count) ** 0.5)


@pytest.mark.parametrize("late_block", [0, 1])
def test_udpros_loses_a_message_with_reordered_blocks(late_block: int) -> None:
    wire = make_wire(
        UDPROS, lambda packet, *_: (5 * MS,) if packet.identity == (f"scan block{late_block}", 0) else (0,)
    )
    publish(wire, [SECOND, 2 * SECOND], 4000)
    wire.run(3 * SECOND)
    assert wire.dropped == {0: "blocks of UDPROS out of order"}
    assert list(wire.delivered) == [1]


@settings(max_examples=20)
@given(st.lists(st.one_of(st.just(()), st.just((0,)), st.just((0, 3 * MS)), st.just((20 * MS,))), max_size=60))
def test_messages_arrive_in_order_and_once_and_all_of_them_after_the_last_loss(
    losses: Sequence[Sequence[int]],
) -> None:
    remaining = iter(losses)
    fast_retry = CallRetry(MS, MS)
    options = Ros1Options(
        tcp=TcpOptions(syn_retries=1, retries=2),
        register=fast_retry,
        update=fast_retry,
        request=fast_retry,
        reconnect=fast_retry,
        silence_ns=SECOND,
        probe_ns=SECOND,
    )
    wire = make_wire(TCPROS, lambda *_: next(remaining, (0,)), options=options)
    publish(wire, [number * 2 * SECOND for number in range(60)])
    wire.run(300 * SECOND)
    assert list(wire.delivered) == sorted(wire.delivered)
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(60))
    assert wire.delivered.keys() >= set(range(50, 60))


def test_an_unknown_flow_is_rejected() -> None:
    wire = make_wire(TCPROS)
    with pytest.raises(ConfigurationError, match="'scam'") as error:
        wire.transports["ros1"].send(Packet(0, "a", "b", 100, ("scam", 0), 0, 0, "ros1"))
    assert "did you mean 'scan'?" in error.value.remedy

"""TCP as a transport of programs: messages arrive in order, once and complete, or are dropped with a reason."""

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Packet
from sim_backends.network.tcp.connection import Tcp
from sim_backends.network.tcp.tcp_options import Congestion, TcpOptions
from sim_backends.network.wire import IpPacket
from tests.helpers.nightly import examples
from tests.helpers.scripted_wire import Script, ScriptedWire, losing

MS = 1_000_000
SECOND = 1000 * MS
DELAY_NS = 10 * MS


def message(
    number: int, *, size_bytes: int = 100, flow: str = "f", source: str = "a", destination: str = "b"
) -> Packet:
    return Packet(number, source, destination, size_bytes, (flow, number), 0, 0, "tcp")


def send_messages(wire: ScriptedWire, packets: Sequence[Packet], options: TcpOptions | None = None) -> None:
    """Send packets at the present time of the wire."""
    transport = wire.transports.setdefault("tcp", Tcp(wire, options))
    for packet in packets:
        transport.send(packet)


def test_a_message_takes_the_handshake_and_one_delay() -> None:
    wire = ScriptedWire(DELAY_NS)
    send_messages(wire, [message(0)])
    wire.run()
    # SYN, SYN-ACK, data: one and a half round trips.
    assert wire.delivered == {0: 3 * DELAY_NS}
    send_messages(wire, [message(1)])
    sent_ns = wire.now_ns
    wire.run()
    assert wire.delivered[1] == sent_ns + DELAY_NS


def test_packets_have_the_sizes_of_linux() -> None:
    wire = ScriptedWire(DELAY_NS)
    send_messages(wire, [message(0, size_bytes=2000)])
    wire.run()
    sizes = [transmission.packet.size_bytes for transmission in wire.transmitted]
    # SYN and SYN-ACK with 20 bytes of options, ACK, a full segment, the rest, and one ACK for both.
    assert sizes == [60, 60, 52, 1500, 2000 - 1448 + 52, 52]


@pytest.mark.parametrize(("lost_syns", "arrives_s"), [(1, 1), (2, 3), (3, 7), (6, 63)])
def test_a_syn_is_retransmitted_after_1_3_7_seconds(lost_syns: int, arrives_s: int) -> None:
    wire = ScriptedWire(DELAY_NS, script=losing({"a": range(lost_syns)}))
    send_messages(wire, [message(0)])
    wire.run()
    assert wire.delivered == {0: arrives_s * SECOND + 3 * DELAY_NS}


def test_a_connection_that_never_opens_drops_its_messages_and_the_next_one_opens_another() -> None:
    wire = ScriptedWire(DELAY_NS, script=losing({"a": range(7)}))
    send_messages(wire, [message(0), message(1)])
    wire.run()
    assert wire.now_ns == 127 * SECOND  # 1 + 2 + 4 + ... + 64: Linux's tcp_syn_retries of 6
    assert wire.dropped == dict.fromkeys((0, 1), "tcp: not connected after 7 tries")
    send_messages(wire, [message(2)])
    wire.run()
    assert wire.delivered == {2: 127 * SECOND + 3 * DELAY_NS}


def test_a_connection_fails_after_15_timeouts() -> None:
    # SYN, ACK and one message arrive; all later packets of the sender are lost.
    wire = ScriptedWire(DELAY_NS, script=losing({"a": range(3, 1000)}))
    send_messages(wire, [message(0)])
    wire.run(SECOND)
    send_messages(wire, [message(1)])
    wire.run()
    # Linux's ip-sysctl of tcp_retries2: "the default value of 15 yields a hypothetical timeout of 924.6 seconds".
    assert wire.now_ns == SECOND + 924_600 * MS
    assert wire.delivered.keys() == {0}
    assert wire.dropped == {1: "tcp: not acknowledged, sent 16 times"}


def test_delivered_messages_are_not_dropped_if_only_acks_are_lost() -> None:
    wire = ScriptedWire(DELAY_NS, script=losing({"b": range(1, 1000)}))
    send_messages(wire, [message(0)], TcpOptions(retries=2))
    wire.run()
    assert wire.delivered == {0: 3 * DELAY_NS}
    assert not wire.dropped


def test_a_late_segment_of_a_failed_connection_is_ignored() -> None:
    late_ns = 500 * SECOND

    def script(packet: IpPacket, _: str, number: int) -> Sequence[int]:
        return (late_ns,) if packet.source == "a" and number == 2 else () if 2 < number < 5 else (0,)

    wire = ScriptedWire(DELAY_NS, script=script)
    send_messages(wire, [message(0)], TcpOptions(retries=2))
    wire.run(late_ns - SECOND)
    assert wire.dropped.keys() == {0}
    send_messages(wire, [message(1)])
    wire.run()
    assert wire.delivered == {1: late_ns - SECOND + 3 * DELAY_NS}


def test_a_late_copy_of_a_syn_does_not_restart_the_stream() -> None:
    wire = ScriptedWire(DELAY_NS, script=lambda packet, *_: (0, 500 * MS) if packet.body[1].syn else (0,))
    send_messages(wire, [message(0)])
    wire.run(SECOND)
    send_messages(wire, [message(1)])
    wire.run()
    assert wire.delivered == {0: 3 * DELAY_NS, 1: SECOND + DELAY_NS}


def test_flows_have_separate_connections() -> None:
    wire = ScriptedWire(
        DELAY_NS, script=lambda packet, *_: () if packet.identity[0].startswith("f 0 syn 0") else (0,)
    )
    send_messages(
        wire,
        [
            message(0),
            message(1, flow="g"),
            message(2, flow="g", source="b", destination="a"),
            message(3, flow="h", destination="c"),
        ],
    )
    wire.run()
    assert wire.delivered == {0: SECOND + 3 * DELAY_NS} | dict.fromkeys((1, 2, 3), 3 * DELAY_NS)


@pytest.mark.parametrize(("reverse_of", "delays"), [("f", 1), ("g", 3), (None, 3)])
def test_the_reverse_direction_of_an_open_connection_needs_no_handshake(reverse_of: str | None, delays: int) -> None:
    wire = ScriptedWire(DELAY_NS)
    send_messages(wire, [message(0)])
    wire.run()
    sent_ns = wire.now_ns
    tcp = wire.transports["tcp"]
    assert isinstance(tcp, Tcp)
    tcp.send(message(1, flow="back", source="b", destination="a"), reverse_of=reverse_of)
    wire.run()
    assert wire.delivered[1] == sent_ns + delays * DELAY_NS


def test_the_reverse_direction_of_an_open_connection_uses_its_round_trip() -> None:
    wire = ScriptedWire(
        DELAY_NS, script=lambda packet, *_: () if packet.identity[0].startswith("back 0 data 0") else (0,)
    )
    send_messages(wire, [message(0)])
    wire.run()
    sent_ns = wire.now_ns
    tcp = wire.transports["tcp"]
    assert isinstance(tcp, Tcp)
    tcp.send(message(1, flow="back", source="b", destination="a"), reverse_of="f")
    wire.run()
    # Without the known round trip the first timeout would be 1 s (RFC 6298, 2.1).
    assert wire.delivered[1] == sent_ns + 200 * MS + DELAY_NS


@pytest.mark.parametrize("invalid_message", [message(7, size_bytes=0), message(7, destination="a")])
def test_an_invalid_message_is_rejected(invalid_message: Packet) -> None:
    with pytest.raises(ConfigurationError, match="packet 7 of flow f: TCP cannot carry"):
        send_messages(ScriptedWire(DELAY_NS), [invalid_message])


def test_every_packet_has_separate_draws() -> None:
    wire = ScriptedWire(DELAY_NS, rate_bit_s=10_000_000, script=losing({"a": {0, 9, 30, 31}, "b": {0, 5}}))
    send_messages(wire, [message(number, size_bytes=1 + 977 * number) for number in range(40)])
    wire.run()
    assert len(wire.delivered) == 40
    identities = [(transmission.packet.source, transmission.packet.identity) for transmission in wire.transmitted]
    assert len(set(identities)) == len(identities)


def test_equal_packets_in_two_runs_have_equal_draws() -> None:
    """With an additional message at the end and other losses, the segments before it have the same draws."""
    packets = [message(number, size_bytes=5000) for number in range(20)]
    base_wire = ScriptedWire(DELAY_NS)
    send_messages(base_wire, packets)
    changed_wire = ScriptedWire(DELAY_NS, script=losing({"a": {4, 5, 40}}))
    send_messages(changed_wire, [*packets, message(20)])

    def sent_identities(wire: ScriptedWire) -> dict[int, tuple[str, int]]:
        wire.run()
        data = [
            transmission.packet
            for transmission in wire.transmitted
            if transmission.packet.source == "a" and transmission.packet.body[1].length
        ]
        return {packet.body[1].first: packet.identity for packet in reversed(data)}

    first, second = sent_identities(base_wire), sent_identities(changed_wire)
    assert first == {number: second[number] for number in first}


deliveries = st.lists(st.sampled_from([(), (0,), (0,), (0, 0), (3 * MS,), (25 * MS,), (0, 300 * MS)]), max_size=60)


def make_script(forward: Sequence[Sequence[int]], reverse: Sequence[Sequence[int]]) -> Script:
    """Return a script that treats packets in order as given; all later packets arrive."""

    def script(packet: IpPacket, _: str, number: int) -> Sequence[int]:
        script_of_direction = forward if packet.source == "a" else reverse
        return script_of_direction[number] if number < len(script_of_direction) else (0,)

    return script


@settings(max_examples=examples(150))
@given(
    forward=deliveries,
    reverse=deliveries,
    sizes=st.lists(st.integers(1, 9000), min_size=1, max_size=30),
    pauses=st.lists(st.integers(0, 400 * MS), min_size=30, max_size=30),
    options=st.builds(
        TcpOptions,
        congestion=st.sampled_from(get_args(Congestion)),
        nagle=st.booleans(),
        mtu_bytes=st.sampled_from([576, 1500]),
        receive_window_bytes=st.sampled_from([1448, 5000, 3 << 20]),
        retries=st.integers(0, 15),
        segments_per_ack=st.integers(1, 3),
    ),
)
def test_the_stream_arrives_in_order_and_once_or_fails_after_any_loss_reordering_or_duplication(
    forward: Sequence[Sequence[int]],
    reverse: Sequence[Sequence[int]],
    sizes: Sequence[int],
    pauses: Sequence[int],
    options: TcpOptions,
) -> None:
    wire = ScriptedWire(DELAY_NS, rate_bit_s=20_000_000, script=make_script(forward, reverse))
    transport = wire.transports["tcp"] = Tcp(wire, options)
    at_ns = 0
    for number, size_bytes in enumerate(sizes):
        at_ns += pauses[number]
        wire.send_at(at_ns, message(number, size_bytes=size_bytes))
    # The wire itself raises an error if a packet is delivered twice, or after it was dropped.
    while len(wire.delivered) + len(wire.dropped) < len(sizes):
        next_ns = wire.next_event_ns()
        assert next_ns is not None, "the connection hangs"
        wire.run(next_ns)
    wire.run()
    for connection in transport._connections.values():
        scoreboard = connection._sender.scoreboard
        assert (len(scoreboard), scoreboard.pipe_bytes, len(scoreboard._arrived_ranges)) == (0, 0, 0)
        assert connection._sender._timer.due_ns is None
        assert connection._sender._reordering_timer.due_ns is None
    assert list(wire.delivered) == sorted(wire.delivered)
    assert all(reason.startswith("tcp: not ") for reason in wire.dropped.values())
    if options.retries == 15:  # at most 60 losses, and a connection fails only after 15 consecutive ones
        assert not wire.dropped or "connected" in next(iter(wire.dropped.values()))
    # An identical second run gives identical results.
    repeated_wire = ScriptedWire(DELAY_NS, rate_bit_s=20_000_000, script=make_script(forward, reverse))
    repeated_wire.transports["tcp"] = Tcp(repeated_wire, replace(options))
    at_ns = 0
    for number, size_bytes in enumerate(sizes):
        at_ns += pauses[number]
        repeated_wire.send_at(at_ns, message(number, size_bytes=size_bytes))
    repeated_wire.run()
    assert repeated_wire.transmitted == wire.transmitted

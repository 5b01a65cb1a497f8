"""Publish-subscribe, compared with closed forms, exchanges computed by hand, and measurements of CycloneDDS."""

import math
from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Packet
from sim_backends.network.topics.qos import MS, SECOND, Qos, RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import (
    AckNack,
    Data,
    Gap,
    Heartbeat,
    NackFrag,
    RtpsMessage,
    Sample,
    Submessage,
    ip_bytes,
)
from sim_backends.network.topics.rtps_transport import Topics
from sim_backends.network.wire import IpPacket
from sim_backends.radio.core.random_streams import PacketDraws
from tests.helpers.scripted_wire import Script, ScriptedWire, lose_packets

BEST_EFFORT = Qos("best_effort")
KEEP_LAST = Qos()
KEEP_ALL = Qos(history="keep_all")
DELAY_NS = MS // 10
PERIOD_NS = 10 * MS
SCAN_BYTES = 2940
"""Size of a LaserScan of 360 beams, as serialized by `rosbags` and CycloneDDS."""


def publish_samples(
    qos: Qos,
    count: int,
    *,
    script: Script | None = None,
    size_bytes: int = SCAN_BYTES,
    timing: RtpsTiming | None = None,
    until_ns: int | None = None,
) -> ScriptedWire:
    """Publish samples at 100 Hz from a to b; packet numbers are those of the samples."""
    wire = ScriptedWire(DELAY_NS, script=script)
    wire.transports["topic"] = Topics(wire, {"scan": TopicFlow("a", "b", qos)}, discovery=None, timing=timing)
    for number in range(count):
        at_ns = number * PERIOD_NS
        wire.send_at(at_ns, Packet(number, "a", "b", size_bytes, ("scan", number), at_ns, at_ns, "topic"))
    wire.run(until_ns)
    return wire


def losing_frames(probability: float, seed: int = 1) -> Script:
    """Return a script that loses Ethernet frames independently; an IP packet needs one or more of them."""
    draws = PacketDraws(seed, "frames")

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        frames = -(-(packet.size_bytes - 20) // 1480)
        return (0,) if all(draws.draw(packet.identity, frame) >= probability for frame in range(frames)) else ()

    return script


def messages(wire: ScriptedWire) -> list[tuple[int, str, tuple[Submessage, ...]]]:
    """Return time, source and submessages of each message."""
    return [
        (transmission.at_ns, transmission.packet.source, transmission.packet.body.submessages)
        for transmission in wire.transmitted
    ]


@pytest.mark.parametrize(
    ("submessages", "size_bytes"),
    [
        # Clause 9.4.5: every submessage has a header of 4 bytes. DATA has 20 more and follows an INFO_TS of 12 bytes;
        # HEARTBEAT has 28 more.
        ((Data(Sample(100, 0), 0, 1, 1, 1344), Heartbeat(1, 1, 1, final=True, directed=False)), 12 + 24 + 100 + 32),
        # One DATA_FRAG, whose header has 32 bytes more, contains a complete LaserScan.
        ((Data(Sample(SCAN_BYTES, 0), 0, 3, 3, 1344),), 12 + 36 + SCAN_BYTES),
        ((Data(Sample(SCAN_BYTES, 0), 2, 1, 3, 1344),), 36 + SCAN_BYTES - 2 * 1344),
        # Messages for one end contain its participant in an INFO_DST of 16 bytes.
        ((AckNack(7, (), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 4),
        ((AckNack(7, (7, 9), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 4 + 4),
        ((AckNack(7, (7, 39), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 8 + 4),
        ((NackFrag(7, (1, 2), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 4 + 4 + 4),
        ((Gap(3, 7),), 16 + 4 + 4 + 4 + 8 + 8 + 4 + 4),
        ((Heartbeat(1, 1, 1, final=False, directed=True),), 16 + 4 + 4 + 4 + 8 + 8 + 4),
    ],
)
def test_message_sizes_follow_the_specification(submessages: tuple[Submessage, ...], size_bytes: int) -> None:
    assert ip_bytes(submessages) == 20 + 8 + 20 + size_bytes


def test_one_sample_takes_two_messages() -> None:
    """Nothing was written before, so the heartbeat after the sample requires a response, which is immediate."""
    wire = publish_samples(KEEP_LAST, 1)
    assert wire.delivered == {0: DELAY_NS}
    (sent_ns, source, (data, heartbeat)), response = messages(wire)
    assert (sent_ns, source, type(data)) == (0, "a", Data)
    assert heartbeat == Heartbeat(1, 1, 1, final=False, directed=False)
    assert response == (DELAY_NS, "b", (AckNack(2, (), 1),))


def test_a_stream_is_acknowledged_at_its_start_and_end() -> None:
    wire = publish_samples(Qos(depth=20), 20)
    # The first sample's heartbeat requires a response; later samples follow within 80 ms and require none.
    final = [submessage.final for _, _, (*_, submessage) in messages(wire) if isinstance(submessage, Heartbeat)]
    assert final == [False] + 19 * [True] + [False]
    # The timer set by the first sample's heartbeat fires every 100 ms, and at 300 ms the last sample is 110 ms old.
    assert messages(wire)[-2:] == [
        (300 * MS, "a", (Heartbeat(2, 20, 21, final=False, directed=False),)),
        (300 * MS + DELAY_NS, "b", (AckNack(21, (), 2),)),
    ]
    assert len(wire.transmitted) == 20 + 1 + 2
    assert list(wire.delivered) == list(range(20))


def test_a_lost_sample_is_requested_after_the_next_heartbeat() -> None:
    wire = publish_samples(KEEP_LAST, 4, script=lose_packets({"a": {1}}), size_bytes=100)
    reported_ns = 2 * PERIOD_NS + DELAY_NS
    assert [entry for entry in messages(wire) if reported_ns <= entry[0] < 3 * PERIOD_NS] == [
        (reported_ns, "b", (AckNack(2, (2,), 2),)),
        (reported_ns + DELAY_NS, "a", (*messages(wire)[2][2][:1], Heartbeat(2, 3, 4, final=False, directed=True))),
        (reported_ns + 2 * DELAY_NS, "b", (AckNack(4, (), 3),)),
    ]
    # Later samples wait for the lost one.
    assert wire.delivered[1] == wire.delivered[2] == reported_ns + 2 * DELAY_NS
    assert list(wire.delivered) == [0, 1, 2, 3]


def test_a_duplicate_request_is_ignored() -> None:
    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return {("b", 1): (), ("a", 1): (0, DELAY_NS)}.get((receiver, number), (0,))

    wire = publish_samples(KEEP_LAST, 4, script=script, size_bytes=100)
    repeated_transmissions = [
        transmission for transmission in wire.transmitted if "again" in transmission.packet.identity[0]
    ]
    assert [transmission.packet.identity for transmission in repeated_transmissions] == [("scan data0 again2", 1)]


def test_a_large_sample_is_repaired_first_by_one_fragment_then_by_the_missing_ones() -> None:
    wire = publish_samples(KEEP_LAST, 3, script=lose_packets({"a": {1}}))
    submessage_types = [
        [type(submessage) for submessage in message] for at_ns, _, message in messages(wire) if at_ns > 2 * PERIOD_NS
    ]
    assert submessage_types[:7] == [
        [AckNack],
        # With the fragment the heartbeat would exceed 1456 bytes.
        [Data],
        [Heartbeat],
        [AckNack, NackFrag],
        [Data],
        [Data, Heartbeat],
        [AckNack],
    ]
    assert wire.delivered[1] == 2 * PERIOD_NS + 5 * DELAY_NS


EVICTED = "evicted from the writer's history before it was acknowledged"


def test_samples_evicted_from_the_history_are_lost() -> None:
    """The second to the fourth of eight samples and the request for the fourth are lost; the history keeps two."""
    wire = publish_samples(Qos(depth=2), 8, script=lose_packets({"a": {1, 2, 3}, "b": {1}}), size_bytes=100)
    assert wire.dropped == dict.fromkeys((1, 2, 3), EVICTED)
    assert list(wire.delivered) == [0, 4, 5, 6, 7]
    # The fifth sample waits until the sixth one's heartbeat reports that the fourth is no longer available.
    assert wire.delivered[4] == wire.delivered[5] == 5 * PERIOD_NS + DELAY_NS


def test_a_request_for_an_evicted_sample_is_answered_by_a_gap() -> None:
    """The request for the second sample is delayed by 15 ms, in which the fourth sample evicts it."""

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return {("b", 1): (), ("a", 1): (15 * MS,)}.get((receiver, number), (0,))

    wire = publish_samples(Qos(depth=2), 4, script=script, size_bytes=100)
    request_ns = 2 * PERIOD_NS + DELAY_NS
    assert (request_ns, "b", (AckNack(2, (2,), 2),)) in messages(wire)
    response = (Gap(2, 3), Heartbeat(3, 4, 5, final=False, directed=True))
    assert (request_ns + 15 * MS + DELAY_NS, "a", response) in messages(wire)
    assert wire.dropped == {1: EVICTED}


@pytest.mark.parametrize("loss", [0.05, 0.2])
@pytest.mark.parametrize(("size_bytes", "frames"), [(100, 1), (SCAN_BYTES, 3), (20_000, 15)])
def test_best_effort_has_the_loss_of_the_link(loss: float, size_bytes: int, frames: int) -> None:
    count = 1000
    wire = publish_samples(BEST_EFFORT, count, script=losing_frames(loss), size_bytes=size_bytes)
    expected = 1 - (1 - loss) ** frames
    lost_count = len(wire.dropped)
    assert lost_count + len(wire.delivered) == count
    assert abs(lost_count / count - expected) < 4 * math.sqrt(expected * (1 - expected) / count)
    assert Counter(wire.dropped.values()) == {"lost by script": lost_count}
    assert all(type(submessage) is Data for _, _, message in messages(wire) for submessage in message)


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.6])
def test_a_reliable_writer_that_keeps_all_samples_loses_none(loss: float) -> None:
    wire = publish_samples(KEEP_ALL, 100, script=losing_frames(loss), size_bytes=500)
    assert list(wire.delivered) == list(range(100))
    assert not wire.dropped


@pytest.mark.parametrize(
    ("qos", "loss", "cyclonedds", "tolerance"),
    [
        # Received of 1000 LaserScans at 100 Hz with real CycloneDDS, and the tolerated difference.
        (BEST_EFFORT, 0.05, 867, 30),
        (BEST_EFFORT, 0.2, 524, 45),
        (KEEP_LAST, 0.05, 967, 15),
        (KEEP_LAST, 0.2, 673, 45),
        (KEEP_ALL, 0.05, 1000, 0),
        (KEEP_ALL, 0.2, 1000, 0),
    ],
)
def test_the_number_of_arrivals_is_near_that_of_cyclonedds(
    qos: Qos, loss: float, cyclonedds: int, tolerance: int
) -> None:
    arrival_count = len(publish_samples(qos, 1000, script=losing_frames(loss)).delivered)
    assert abs(arrival_count - cyclonedds) <= tolerance


def test_a_blocked_writer_drops_samples_after_max_blocking_time() -> None:
    """Nothing is acknowledged; 10 samples fit below the watermark of 30,720 bytes, and the 11th exceeds it."""
    qos = Qos(history="keep_all", max_blocking_ns=50 * MS)
    timing = RtpsTiming(max_high_bytes=30_720)
    wire = publish_samples(qos, 40, script=lambda packet, *_: (), timing=timing, until_ns=SECOND)
    reason = "the writer was blocked for longer than max_blocking_time"
    assert Counter(wire.dropped.values()) == {reason: 40 - 11}
    assert wire.next_event_ns() is not None, "there are unacknowledged samples"


def test_samples_of_many_datagrams_arrive_complete() -> None:
    """A camera image takes 75 messages of 10 fragments, more fragments than a bitmap of 256 can contain."""
    wire = publish_samples(KEEP_LAST, 1, script=lose_packets({"a": {*range(50), 80, 81}}), size_bytes=1_000_000)
    assert list(wire.delivered) == [0]
    requests = [
        submessage for _, _, message in messages(wire) for submessage in message if isinstance(submessage, NackFrag)
    ]
    assert max(len(request.missing) for request in requests) == 256
    assert all(transmission.packet.size_bytes <= 14_720 + 28 for transmission in wire.transmitted)


DeliveryDelays = Sequence[int]
DELIVERIES = st.lists(
    st.one_of(st.just(()), st.just((0,)), st.lists(st.integers(0, 30 * MS), min_size=1, max_size=3)), max_size=120
)


def make_script(deliveries: Sequence[DeliveryDelays]) -> Script:
    """Return a script that delivers packets of both ends in order as given; all later packets arrive."""
    remaining = iter(deliveries)
    return lambda *_: next(remaining, (0,))


@given(
    DELIVERIES,
    st.integers(1, 30),
    st.sampled_from([100, SCAN_BYTES, 15_000]),
    st.sampled_from([KEEP_ALL, Qos(depth=2)]),
)
def test_samples_arrive_in_order_and_once_after_any_losses(
    deliveries: Sequence[DeliveryDelays], count: int, size_bytes: int, qos: Qos
) -> None:
    wire = publish_samples(qos, count, script=make_script(deliveries), size_bytes=size_bytes)
    assert list(wire.delivered) == sorted(wire.delivered)
    # The wire raises an error for a second result of a sample; each sample has one.
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(count))
    if qos is KEEP_ALL:
        assert not wire.dropped


@given(DELIVERIES, st.integers(1, 30), st.sampled_from([100, 15_000]))
def test_best_effort_samples_arrive_in_order_and_once(
    deliveries: Sequence[DeliveryDelays], count: int, size_bytes: int
) -> None:
    wire = publish_samples(BEST_EFFORT, count, script=make_script(deliveries), size_bytes=size_bytes)
    assert list(wire.delivered) == sorted(wire.delivered)
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(count))
    assert set(wire.dropped.values()) <= {"lost by script", "overtaken by a later sample"}


@given(DELIVERIES, st.integers(1, 10))
def test_an_event_is_scheduled_while_samples_are_unacknowledged(
    deliveries: Sequence[DeliveryDelays], count: int
) -> None:
    """Run from event to event until the writer has received the acknowledgement of its last sample."""
    wire = publish_samples(KEEP_ALL, count, script=make_script(deliveries), until_ns=0)
    last_acknowledged = 0
    topics = wire.transports["topic"]
    receive = topics.receive

    def record_acknowledgement(host: str, packet: IpPacket) -> None:
        nonlocal last_acknowledged
        message: RtpsMessage = packet.body
        last_acknowledged = max(
            [
                last_acknowledged,
                *(submessage.base - 1 for submessage in message.submessages if isinstance(submessage, AckNack)),
            ]
        )
        receive(host, packet)

    topics.receive = record_acknowledgement  # type: ignore[method-assign]
    while last_acknowledged < count:
        next_ns = wire.next_event_ns()
        assert next_ns is not None
        wire.run(next_ns)


def test_invalid_quality_of_service_is_rejected() -> None:
    with pytest.raises(ConfigurationError, match="depth of 0 samples"):
        Qos(depth=0)
    with pytest.raises(ConfigurationError, match="keep_some"):
        Qos(history="keep_some")  # type: ignore[arg-type]


def test_an_unknown_flow_is_rejected() -> None:
    wire = ScriptedWire(0)
    topics = Topics(wire, {"scan": TopicFlow("a", "b")}, discovery=None)
    with pytest.raises(ConfigurationError, match="'scam'") as error:
        topics.send(Packet(0, "a", "b", 100, ("scam", 0), 0, 0, "topic"))
    assert "did you mean 'scan'?" in error.value.remedy

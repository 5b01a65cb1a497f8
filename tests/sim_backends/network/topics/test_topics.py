"""Publish-subscribe against closed forms, exchanges worked out by hand, and what CycloneDDS did when it was tried."""

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
from sim_backends.network.topics.transport import Topics
from sim_backends.network.wire import IpPacket
from sim_backends.radio.random_streams import PacketDraws
from tests.helpers.scripted_wire import Script, ScriptedWire, losing

BEST_EFFORT = Qos("best_effort")
KEEP_LAST = Qos()
KEEP_ALL = Qos(history="keep_all")
DELAY_NS = MS // 10
PERIOD_NS = 10 * MS
SCAN_BYTES = 2940
"""A LaserScan of 360 beams, as `rosbags` and CycloneDDS serialize it."""


def published(
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
    """Lose frames, of which an IP packet takes as many as Ethernet needs for it, independently of each other."""
    draws = PacketDraws(seed, "frames")

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        frames = -(-(packet.size_bytes - 20) // 1480)
        return (0,) if all(draws.draw(packet.identity, frame) >= probability for frame in range(frames)) else ()

    return script


def said(wire: ScriptedWire) -> list[tuple[int, str, tuple[Submessage, ...]]]:
    """Return when who said what."""
    return [(one.at_ns, one.packet.source, one.packet.body.submessages) for one in wire.transmitted]


@pytest.mark.parametrize(
    ("submessages", "size_bytes"),
    [
        # Clause 9.4.5: 4 bytes of header each; DATA 20 more, after INFO_TS with 12; HEARTBEAT 28 more.
        ((Data(Sample(100, 0), 0, 1, 1, 1344), Heartbeat(1, 1, 1, final=True, directed=False)), 12 + 24 + 100 + 32),
        # All of a LaserScan in one DATA_FRAG, whose header has 32 bytes more.
        ((Data(Sample(SCAN_BYTES, 0), 0, 3, 3, 1344),), 12 + 36 + SCAN_BYTES),
        ((Data(Sample(SCAN_BYTES, 0), 2, 1, 3, 1344),), 36 + SCAN_BYTES - 2 * 1344),
        # What goes to one end names its participant by INFO_DST with 16 bytes.
        ((AckNack(7, (), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 4),
        ((AckNack(7, (7, 9), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 4 + 4),
        ((AckNack(7, (7, 39), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 8 + 4),
        ((NackFrag(7, (1, 2), 1),), 16 + 4 + 4 + 4 + 8 + 4 + 4 + 4 + 4),
        ((Gap(3, 7),), 16 + 4 + 4 + 4 + 8 + 8 + 4 + 4),
        ((Heartbeat(1, 1, 1, final=False, directed=True),), 16 + 4 + 4 + 4 + 8 + 8 + 4),
    ],
)
def test_sizes_are_those_of_the_specification(submessages: tuple[Submessage, ...], size_bytes: int) -> None:
    assert ip_bytes(submessages) == 20 + 8 + 20 + size_bytes


def test_one_sample_takes_two_messages() -> None:
    """Nothing was written before, so the heartbeat behind the sample asks at once, and is answered at once."""
    wire = published(KEEP_LAST, 1)
    assert wire.delivered == {0: DELAY_NS}
    (sent_ns, by, (data, heartbeat)), answer = said(wire)
    assert (sent_ns, by, type(data)) == (0, "a", Data)
    assert heartbeat == Heartbeat(1, 1, 1, final=False, directed=False)
    assert answer == (DELAY_NS, "b", (AckNack(2, (), 1),))


def test_a_stream_is_acknowledged_at_its_beginning_and_at_its_end() -> None:
    wire = published(Qos(depth=20), 20)
    # The first sample asks; later ones follow within 80 ms of each other and ask for nothing.
    final = [submessage.final for _, _, (*_, submessage) in said(wire) if isinstance(submessage, Heartbeat)]
    assert final == [False] + 19 * [True] + [False]
    # The alarm of the first sample's heartbeat rings every 100 ms, and at 300 ms the last sample is 110 ms old.
    assert said(wire)[-2:] == [
        (300 * MS, "a", (Heartbeat(2, 20, 21, final=False, directed=False),)),
        (300 * MS + DELAY_NS, "b", (AckNack(21, (), 2),)),
    ]
    assert len(wire.transmitted) == 20 + 1 + 2
    assert list(wire.delivered) == list(range(20))


def test_a_lost_sample_is_asked_for_by_the_next_ones_heartbeat() -> None:
    wire = published(KEEP_LAST, 4, script=losing({"a": {1}}), size_bytes=100)
    reported_ns = 2 * PERIOD_NS + DELAY_NS
    assert [entry for entry in said(wire) if reported_ns <= entry[0] < 3 * PERIOD_NS] == [
        (reported_ns, "b", (AckNack(2, (2,), 2),)),
        (reported_ns + DELAY_NS, "a", (*said(wire)[2][2][:1], Heartbeat(2, 3, 4, final=False, directed=True))),
        (reported_ns + 2 * DELAY_NS, "b", (AckNack(4, (), 3),)),
    ]
    # What came after it waited for it.
    assert wire.delivered[1] == wire.delivered[2] == reported_ns + 2 * DELAY_NS
    assert list(wire.delivered) == [0, 1, 2, 3]


def test_a_copy_of_a_request_is_not_answered() -> None:
    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return {("b", 1): (), ("a", 1): (0, DELAY_NS)}.get((receiver, number), (0,))

    wire = published(KEEP_LAST, 4, script=script, size_bytes=100)
    repeated = [one for one in wire.transmitted if "again" in one.packet.identity[0]]
    assert [one.packet.identity for one in repeated] == [("scan data0 again2", 1)]


def test_a_large_sample_comes_back_first_by_one_fragment_then_by_those_that_lack() -> None:
    wire = published(KEEP_LAST, 3, script=losing({"a": {1}}))
    kinds = [[type(one) for one in message] for at_ns, _, message in said(wire) if at_ns > 2 * PERIOD_NS]
    assert kinds[:7] == [
        [AckNack],
        # The fragment leaves no room for the heartbeat below 1456 bytes.
        [Data],
        [Heartbeat],
        [AckNack, NackFrag],
        [Data],
        [Data, Heartbeat],
        [AckNack],
    ]
    assert wire.delivered[1] == 2 * PERIOD_NS + 5 * DELAY_NS


PUSHED_OUT = "pushed out of the writer's history before it was acknowledged"


def test_samples_that_the_history_has_no_room_for_are_lost() -> None:
    """Of eight samples the second to the fourth are lost, and so is the request for the fourth; two are kept."""
    wire = published(Qos(depth=2), 8, script=losing({"a": {1, 2, 3}, "b": {1}}), size_bytes=100)
    assert wire.dropped == dict.fromkeys((1, 2, 3), PUSHED_OUT)
    assert list(wire.delivered) == [0, 4, 5, 6, 7]
    # The fifth waits for the fourth until the sixth one's heartbeat says that this one is gone.
    assert wire.delivered[4] == wire.delivered[5] == 5 * PERIOD_NS + DELAY_NS


def test_what_is_asked_for_and_gone_is_told_by_a_gap() -> None:
    """The request for the second sample takes 15 ms longer, and in between the fourth pushes that out."""

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        return {("b", 1): (), ("a", 1): (15 * MS,)}.get((receiver, number), (0,))

    wire = published(Qos(depth=2), 4, script=script, size_bytes=100)
    asked_ns = 2 * PERIOD_NS + DELAY_NS
    assert (asked_ns, "b", (AckNack(2, (2,), 2),)) in said(wire)
    told = (Gap(2, 3), Heartbeat(3, 4, 5, final=False, directed=True))
    assert (asked_ns + 15 * MS + DELAY_NS, "a", told) in said(wire)
    assert wire.dropped == {1: PUSHED_OUT}


@pytest.mark.parametrize("loss", [0.05, 0.2])
@pytest.mark.parametrize(("size_bytes", "frames"), [(100, 1), (SCAN_BYTES, 3), (20_000, 15)])
def test_best_effort_loses_what_the_link_loses(loss: float, size_bytes: int, frames: int) -> None:
    count = 1000
    wire = published(BEST_EFFORT, count, script=losing_frames(loss), size_bytes=size_bytes)
    expected = 1 - (1 - loss) ** frames
    lost = len(wire.dropped)
    assert lost + len(wire.delivered) == count
    assert abs(lost / count - expected) < 4 * math.sqrt(expected * (1 - expected) / count)
    assert Counter(wire.dropped.values()) == {"lost by script": lost}
    assert all(type(one) is Data for _, _, message in said(wire) for one in message)


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.6])
def test_reliable_keep_all_loses_nothing(loss: float) -> None:
    wire = published(KEEP_ALL, 100, script=losing_frames(loss), size_bytes=500)
    assert list(wire.delivered) == list(range(100))
    assert not wire.dropped


@pytest.mark.parametrize(
    ("qos", "loss", "cyclonedds", "within"),
    [
        # Of 1000 LaserScans at 100 Hz; what the program of that measurement got, and how far ours may be from it.
        (BEST_EFFORT, 0.05, 867, 30),
        (BEST_EFFORT, 0.2, 524, 45),
        (KEEP_LAST, 0.05, 967, 15),
        (KEEP_LAST, 0.2, 673, 45),
        (KEEP_ALL, 0.05, 1000, 0),
        (KEEP_ALL, 0.2, 1000, 0),
    ],
)
def test_as_many_samples_arrive_as_with_cyclonedds(qos: Qos, loss: float, cyclonedds: int, within: int) -> None:
    arrived = len(published(qos, 1000, script=losing_frames(loss)).delivered)
    assert abs(arrived - cyclonedds) <= within


def test_a_blocked_writer_drops_what_waited_too_long() -> None:
    """Nothing is acknowledged; below the mark of 30,720 bytes are 10 samples, and another goes beyond it."""
    qos = Qos(history="keep_all", max_blocking_ns=50 * MS)
    timing = RtpsTiming(most_high_bytes=30_720)
    wire = published(qos, 40, script=lambda packet, *_: (), timing=timing, until_ns=SECOND)
    reason = "the writer was blocked for longer than max_blocking_time"
    assert Counter(wire.dropped.values()) == {reason: 40 - 11}
    assert wire.next_event_ns() is not None, "something is unacknowledged"


def test_samples_of_many_datagrams_come_whole() -> None:
    """A camera's image takes 75 messages of 10 fragments, and more fragments than one bitmap of 256 names."""
    wire = published(KEEP_LAST, 1, script=losing({"a": {*range(50), 80, 81}}), size_bytes=1_000_000)
    assert list(wire.delivered) == [0]
    asked = [one for _, _, message in said(wire) for one in message if isinstance(one, NackFrag)]
    assert max(len(one.missing) for one in asked) == 256
    assert all(one.packet.size_bytes <= 14_720 + 28 for one in wire.transmitted)


Fate = Sequence[int]
FATES = st.lists(
    st.one_of(st.just(()), st.just((0,)), st.lists(st.integers(0, 30 * MS), min_size=1, max_size=3)), max_size=120
)


def by_fates(fates: Sequence[Fate]) -> Script:
    """Let packets meet these fates one after the other, from whomever; from then on all arrive."""
    left = iter(fates)
    return lambda *_: next(left, (0,))


@given(
    FATES, st.integers(1, 30), st.sampled_from([100, SCAN_BYTES, 15_000]), st.sampled_from([KEEP_ALL, Qos(depth=2)])
)
def test_whatever_happens_to_messages_samples_come_in_order_and_once(
    fates: Sequence[Fate], count: int, size_bytes: int, qos: Qos
) -> None:
    wire = published(qos, count, script=by_fates(fates), size_bytes=size_bytes)
    assert list(wire.delivered) == sorted(wire.delivered)
    # The wire refuses a second fate of a sample; each has one.
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(count))
    if qos is KEEP_ALL:
        assert not wire.dropped


@given(FATES, st.integers(1, 30), st.sampled_from([100, 15_000]))
def test_best_effort_comes_in_order_and_once(fates: Sequence[Fate], count: int, size_bytes: int) -> None:
    wire = published(BEST_EFFORT, count, script=by_fates(fates), size_bytes=size_bytes)
    assert list(wire.delivered) == sorted(wire.delivered)
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(count))
    assert set(wire.dropped.values()) <= {"lost by script", "overtaken by a later sample"}


@given(FATES, st.integers(1, 10))
def test_something_is_planned_while_anything_is_unacknowledged(fates: Sequence[Fate], count: int) -> None:
    """Step by step, until the writer has heard that its last sample arrived."""
    wire = published(KEEP_ALL, count, script=by_fates(fates), until_ns=0)
    heard = 0
    topics = wire.transports["topic"]
    receive = topics.receive

    def listening(host: str, packet: IpPacket) -> None:
        nonlocal heard
        message: RtpsMessage = packet.body
        heard = max([heard, *(one.base - 1 for one in message.submessages if isinstance(one, AckNack))])
        receive(host, packet)

    topics.receive = listening  # type: ignore[method-assign]
    while heard < count:
        next_ns = wire.next_event_ns()
        assert next_ns is not None
        wire.run(next_ns)


def test_bad_quality_of_service_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="history of 0 samples"):
        Qos(depth=0)
    with pytest.raises(ConfigurationError, match="keep_some"):
        Qos(history="keep_some")  # type: ignore[arg-type]


def test_a_flow_that_no_topic_is_known_for_is_refused() -> None:
    wire = ScriptedWire(0)
    topics = Topics(wire, {"scan": TopicFlow("a", "b")}, discovery=None)
    with pytest.raises(ConfigurationError, match="'scam'") as error:
        topics.send(Packet(0, "a", "b", 100, ("scam", 0), 0, 0, "topic"))
    assert "did you mean 'scan'?" in error.value.remedy

"""The reader of a flow by itself: what it answers to what its writer says."""

from sim_backends.network.topics.qos import MS, SECOND, Qos, RtpsTiming, TopicFlow
from sim_backends.network.topics.reader import TopicReader
from sim_backends.network.topics.rtps import AckNack, Data, Gap, Heartbeat, Sample, Submessage
from tests.helpers.scripted_wire import ScriptedWire

TIMING = RtpsTiming()


class Heard:
    """A reader, what it delivered and what it said, with the time."""

    def __init__(self) -> None:
        self.wire = ScriptedWire(0)
        self.delivered: list[int] = []
        self.said: list[tuple[int, tuple[Submessage, ...]]] = []
        self.reader = TopicReader(
            self.wire,
            TopicFlow("a", "b", Qos()),
            TIMING,
            lambda submessages, key: self.said.append((self.wire.now_ns, submessages)),
            lambda sample: self.delivered.append(sample.number),
        )
        self.reader.match(begin=False)

    def take(self, at_ns: int, *submessages: Data | Heartbeat | Gap) -> None:
        self.wire.run(at_ns)
        for submessage in submessages:
            self.reader.take(submessage)


def data(number: int) -> Data:
    return Data(Sample(100, number, number=number), 0, 1, 1, 1344)


def test_a_copy_of_what_was_delivered_changes_nothing() -> None:
    heard = Heard()
    heard.take(0, data(1), data(2), data(1))
    heard.take(MS, Heartbeat(2, 2, 1, final=False, directed=False))
    heard.wire.run(2 * MS)
    assert heard.delivered == [1, 2]
    assert heard.said == [(MS, (AckNack(3, (), 1),))]


def test_what_is_missing_is_asked_for_again_when_no_heartbeat_comes() -> None:
    heard = Heard()
    heard.take(0, data(2), Heartbeat(1, 2, 1, final=True, directed=False))
    heard.wire.run(7 * SECOND)
    assert heard.said == [(number * 3 * SECOND, (AckNack(1, (1,), number + 1),)) for number in range(3)]


def test_the_same_is_asked_for_no_sooner_than_a_delay_unless_the_writer_has_answered() -> None:
    heard = Heard()
    heard.take(0, data(2), Heartbeat(1, 2, 1, final=True, directed=False))
    heard.take(10 * MS, Heartbeat(1, 2, 2, final=True, directed=False))
    heard.take(20 * MS, Heartbeat(1, 2, 3, final=False, directed=True))
    heard.take(30 * MS, Heartbeat(1, 2, 4, final=True, directed=False))
    heard.wire.run(SECOND)
    assert [at_ns for at_ns, _ in heard.said] == [0, 20 * MS, 120 * MS]


def test_an_old_heartbeat_is_not_taken() -> None:
    heard = Heard()
    heard.take(0, data(1), Heartbeat(1, 1, 5, final=False, directed=False))
    heard.take(SECOND, Heartbeat(1, 9, 4, final=False, directed=False))
    heard.wire.run(2 * SECOND)
    assert heard.said == [(0, (AckNack(2, (), 1),))]


def test_a_gap_lets_what_waited_go() -> None:
    heard = Heard()
    heard.take(0, data(3))
    assert not heard.delivered
    heard.take(MS, Gap(1, 3))
    assert heard.delivered == [3]

"""The reader of a flow without its writer: its responses to submessages."""

from sim_backends.network.topics.qos import MS, SECOND, Qos, RtpsTiming, TopicFlow
from sim_backends.network.topics.reader import TopicReader
from sim_backends.network.topics.rtps import AckNack, Data, Gap, Heartbeat, Sample, Submessage
from tests.helpers.scripted_wire import ScriptedWire

TIMING = RtpsTiming()


class ReaderRun:
    """A reader, its delivered samples and its sent messages, with times."""

    def __init__(self) -> None:
        self.wire = ScriptedWire(0)
        self.delivered: list[int] = []
        self.sent: list[tuple[int, tuple[Submessage, ...]]] = []
        self.reader = TopicReader(
            self.wire,
            TopicFlow("a", "b", Qos()),
            TIMING,
            lambda submessages, key: self.sent.append((self.wire.now_ns, submessages)),
            lambda sample: self.delivered.append(sample.number),
        )
        self.reader.match(request_heartbeat=False)

    def receive(self, at_ns: int, *submessages: Data | Heartbeat | Gap) -> None:
        self.wire.run(at_ns)
        for submessage in submessages:
            self.reader.on_message(submessage)


def data(number: int) -> Data:
    return Data(Sample(100, number, number=number), 0, 1, 1, 1344)


def test_a_duplicate_sample_is_ignored() -> None:
    run = ReaderRun()
    run.receive(0, data(1), data(2), data(1))
    run.receive(MS, Heartbeat(2, 2, 1, final=False, directed=False))
    run.wire.run(2 * MS)
    assert run.delivered == [1, 2]
    assert run.sent == [(MS, (AckNack(3, (), 1),))]


def test_a_missing_sample_is_requested_again_without_a_heartbeat() -> None:
    run = ReaderRun()
    run.receive(0, data(2), Heartbeat(1, 2, 1, final=True, directed=False))
    run.wire.run(7 * SECOND)
    assert run.sent == [(number * 3 * SECOND, (AckNack(1, (1,), number + 1),)) for number in range(3)]


def test_a_request_is_repeated_after_a_delay_or_a_directed_heartbeat() -> None:
    run = ReaderRun()
    run.receive(0, data(2), Heartbeat(1, 2, 1, final=True, directed=False))
    run.receive(10 * MS, Heartbeat(1, 2, 2, final=True, directed=False))
    run.receive(20 * MS, Heartbeat(1, 2, 3, final=False, directed=True))
    run.receive(30 * MS, Heartbeat(1, 2, 4, final=True, directed=False))
    run.wire.run(SECOND)
    assert [at_ns for at_ns, _ in run.sent] == [0, 20 * MS, 120 * MS]


def test_an_old_heartbeat_is_ignored() -> None:
    run = ReaderRun()
    run.receive(0, data(1), Heartbeat(1, 1, 5, final=False, directed=False))
    run.receive(SECOND, Heartbeat(1, 9, 4, final=False, directed=False))
    run.wire.run(2 * SECOND)
    assert run.sent == [(0, (AckNack(2, (), 1),))]


def test_a_gap_releases_waiting_samples() -> None:
    run = ReaderRun()
    run.receive(0, data(3))
    assert not run.delivered
    run.receive(MS, Gap(1, 3))
    assert run.delivered == [3]

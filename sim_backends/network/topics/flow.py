"""A flow of publish-subscribe: a writer, its reader, and the account of what became of each sample.

The two ends know of each other only by messages. The account knows both: a sample will never arrive once its writer
sends it no more, nothing of it is under way, and its reader does not hold it.
"""

from collections.abc import Callable
from typing import Final

from sim_backends.network.topics.qos import RtpsTiming, TopicFlow
from sim_backends.network.topics.reader import TopicReader
from sim_backends.network.topics.rtps import (
    AckNack,
    Data,
    Heartbeat,
    NackFrag,
    RtpsMessage,
    Sample,
    Submessage,
    ip_bytes,
)
from sim_backends.network.topics.writer import TopicWriter
from sim_backends.network.wire import IpPacket, Wire
from sim_backends.radio.random_streams import PacketIdentity

TRANSPORT: Final = "topic"
"""Name of the transport, as packets of programs have it."""
NOT_MATCHED: Final = "not matched yet"


class TopicSession:
    """Writer and reader of one flow.

    Args:
        wire: What messages go over.
        name: Of the flow.
        flow: Who publishes to whom, and how.
        timing: Of the protocol.
        deliver: Called with a sample that is delivered.
        drop: Called with one that never will be, and the reason.
        topics: For how many topics that share messages a message has its heartbeats and acknowledgements.

    Attributes:
        writer: At the publisher.
        reader: At the subscriber.
    """

    def __init__(
        self,
        wire: Wire,
        name: str,
        flow: TopicFlow,
        timing: RtpsTiming,
        *,
        deliver: Callable[[Sample], None],
        drop: Callable[[Sample, str], None],
        topics: int = 1,
    ) -> None:
        self._wire = wire
        self._name = name
        self._flow = flow
        self._deliver = deliver
        self._drop = drop
        self._topics = topics
        self._reliable = flow.qos.reliability == "reliable"
        self.writer = TopicWriter(wire, flow, timing, self._to_reader, self._give_up)
        self.reader = TopicReader(wire, flow, timing, self._to_writer, self._take)

    def receive(self, host: str, message: RtpsMessage) -> None:
        """Take a message that arrived at `host`."""
        samples = self._land(message)
        at_reader = host == self._flow.subscriber
        for submessage in message.submessages:
            if isinstance(submessage, AckNack | NackFrag):
                if not at_reader:
                    self.writer.take(submessage)
            elif at_reader:
                self.reader.take(submessage)
        for sample in samples:
            if not self._reliable and not self.reader.matched:
                sample.given_up = NOT_MATCHED
            self._settle(sample)

    def lost(self, message: RtpsMessage, reason: str) -> None:
        """Learn, for the account, that a message will not arrive."""
        for sample in self._land(message):
            if not self._reliable:
                sample.given_up = reason
            self._settle(sample)

    def unmatch_reader(self) -> None:
        """Let the reader have no writer any more."""
        for sample in self.reader.unmatch():
            self._settle(sample)

    def _land(self, message: RtpsMessage) -> list[Sample]:
        """Return the samples of a message that is heard of for the first time, a copy after which changes nothing."""
        if message.landed:
            return []
        message.landed = True
        samples = [one.sample for one in message.submessages if isinstance(one, Data)]
        for sample in samples:
            sample.under_way -= 1
        return samples

    def _take(self, sample: Sample) -> None:
        if not sample.settled:
            sample.settled = True
            self._deliver(sample)

    def _give_up(self, sample: Sample, reason: str) -> None:
        sample.given_up = reason
        self._settle(sample)

    def _settle(self, sample: Sample) -> None:
        if sample.given_up and not sample.under_way and not sample.held and not sample.settled:
            sample.settled = True
            self._drop(sample, sample.given_up)

    def _to_reader(self, submessages: tuple[Submessage, ...], key: PacketIdentity) -> None:
        for submessage in submessages:
            if isinstance(submessage, Data):
                submessage.sample.under_way += 1
        self._transmit(self._flow.publisher, self._flow.subscriber, submessages, key)

    def _to_writer(self, submessages: tuple[Submessage, ...], key: PacketIdentity) -> None:
        self._transmit(self._flow.subscriber, self._flow.publisher, submessages, key)

    def _transmit(
        self, source: str, destination: str, submessages: tuple[Submessage, ...], key: PacketIdentity
    ) -> None:
        kind, number = key
        identity = f"{self._name} {kind}", number
        message = RtpsMessage(self._name, submessages)
        size_bytes = ip_bytes(submessages)
        if self._topics > 1:
            size_bytes += (self._topics - 1) * sum(
                one.size_bytes for one in submessages if isinstance(one, Heartbeat | AckNack)
            )
        self._wire.transmit(IpPacket(source, destination, TRANSPORT, size_bytes, identity, message))

"""A publish-subscribe flow: a writer, its reader, and the record of the result of each sample.

The two ends exchange information only by messages. The record uses the state of both ends: a sample will never arrive
if its writer has given it up, no message with a part of it is in flight, and its reader has not stored all of it.
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
from sim_backends.radio.core.random_streams import PacketIdentity

TRANSPORT: Final = "topic"
"""Name of the transport, as in packets of programs."""
NOT_MATCHED: Final = "not matched yet"


class TopicSession:
    """Writer and reader of one flow.

    Args:
        wire: The network below.
        name: Name of the flow.
        flow: Publisher, subscriber and quality of service.
        timing: Times of the protocol.
        deliver: Called with each delivered sample.
        drop: Called with each sample that will never be delivered, and the reason.
        topics: Number of topics that share the messages; each message has heartbeats and acknowledgements for all of
            them.

    Attributes:
        writer: The writer at the publisher.
        reader: The reader at the subscriber.
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
        self._is_reliable = flow.qos.reliability == "reliable"
        self.writer = TopicWriter(wire, flow, timing, self._to_reader, self._on_give_up)
        self.reader = TopicReader(wire, flow, timing, self._to_writer, self._on_delivered)

    def receive(self, host: str, message: RtpsMessage) -> None:
        """Process a message that arrived at `host`."""
        samples = self._mark_resolved(message)
        is_at_reader = host == self._flow.subscriber
        for submessage in message.submessages:
            if isinstance(submessage, AckNack | NackFrag):
                if not is_at_reader:
                    self.writer.on_acknack(submessage)
            elif is_at_reader:
                self.reader.on_message(submessage)
        for sample in samples:
            if not self._is_reliable and not self.reader.is_matched:
                sample.give_up_reason = NOT_MATCHED
            self._settle(sample)

    def record_loss(self, message: RtpsMessage, reason: str) -> None:
        """Record, for statistics only, that a message will not arrive."""
        for sample in self._mark_resolved(message):
            if not self._is_reliable:
                sample.give_up_reason = reason
            self._settle(sample)

    def unmatch_reader(self) -> None:
        """Unmatch the reader from its writer; samples that wait at the reader for an earlier sample are discarded."""
        for sample in self.reader.remove_writer():
            self._settle(sample)

    def _mark_resolved(self, message: RtpsMessage) -> list[Sample]:
        """Mark a message as arrived or lost; return its samples the first time, and none for further copies."""
        if message.is_resolved:
            return []
        message.is_resolved = True
        samples = [submessage.sample for submessage in message.submessages if isinstance(submessage, Data)]
        for sample in samples:
            sample.in_flight -= 1
        return samples

    def _on_delivered(self, sample: Sample) -> None:
        if not sample.is_settled:
            sample.is_settled = True
            self._deliver(sample)

    def _on_give_up(self, sample: Sample, reason: str) -> None:
        sample.give_up_reason = reason
        self._settle(sample)

    def _settle(self, sample: Sample) -> None:
        if sample.give_up_reason and not sample.in_flight and not sample.is_stored and not sample.is_settled:
            sample.is_settled = True
            self._drop(sample, sample.give_up_reason)

    def _to_reader(self, submessages: tuple[Submessage, ...], key: PacketIdentity) -> None:
        for submessage in submessages:
            if isinstance(submessage, Data):
                submessage.sample.in_flight += 1
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
                submessage.size_bytes for submessage in submessages if isinstance(submessage, Heartbeat | AckNack)
            )
        self._wire.transmit(IpPacket(source, destination, TRANSPORT, size_bytes, identity, message))

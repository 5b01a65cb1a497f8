"""Programs that send packets: periodic traffic, echo requests and replies, and the messages of a bag."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sim_backends.cosim.federates import Action
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.world.motion import State


class Periodic:
    """Publishes its agent's state at a fixed rate.

    Args:
        flow: Name of the flow.
        destination: Name of the receiving agent.
        period_ns: Time between packets.
        size_bytes: Size of each packet.
        first_ns: Time of the first packet.
        stop_ns: Time from which nothing is sent; None to send until the end.
        protocol: Name of the transport.
    """

    def __init__(
        self,
        flow: str,
        destination: str,
        *,
        period_ns: int,
        size_bytes: int = 100,
        first_ns: int = 0,
        stop_ns: int | None = None,
        protocol: str = "udp",
    ) -> None:
        self._flow = flow
        self._destination = destination
        self._period_ns = period_ns
        self._size_bytes = size_bytes
        self._next_ns = first_ns
        self._stop_ns = stop_ns
        self._protocol = protocol
        self._number = 0

    def next_wake_ns(self) -> int | None:
        """Return the time of the next packet, or None if no packet is left before `stop_ns`."""
        return None if self._stop_ns is not None and self._next_ns >= self._stop_ns else self._next_ns

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Send a packet if it is due."""
        wake_ns = self.next_wake_ns()
        if wake_ns is None or now_ns < wake_ns:
            return Action()
        datagram = Datagram(self._destination, self._size_bytes, self._flow, self._number, own_state, self._protocol)
        self._number += 1
        # The packets that were missed because a clock was set ahead are skipped.
        self._next_ns += self._period_ns * ((now_ns - wake_ns) // self._period_ns + 1)
        return Action((datagram,))


REPLY = "/reply"
"""Suffix of the name of the flow of replies."""


@dataclass(frozen=True, slots=True)
class PingRequest:
    """The payload of a request.

    Attributes:
        flow: Its flow.
        number: Its number in the flow.
        size_bytes: Size of the request and of its reply.
        protocol: Transport of request and reply.
    """

    flow: str
    number: int
    size_bytes: int
    protocol: str


class EchoRequester:
    """Sends requests at a constant rate.

    Args:
        flow: Name of the flow.
        destination: Name of the agent that replies.
        count: Number of requests.
        interval_ns: Time between requests.
        size_bytes: Size of each request.
        first_ns: Time of the first request.
        protocol: Name of the transport.
    """

    def __init__(
        self,
        flow: str,
        destination: str,
        *,
        count: int,
        interval_ns: int,
        size_bytes: int = 56,
        first_ns: int = 0,
        protocol: str = "udp",
    ) -> None:
        self._flow = flow
        self._destination = destination
        self._count = count
        self._interval_ns = interval_ns
        self._size_bytes = size_bytes
        self._next_ns = first_ns
        self._protocol = protocol
        self._sent_count = 0

    def next_wake_ns(self) -> int | None:
        """Return the time of the next request, or None after the last."""
        return self._next_ns if self._sent_count < self._count else None

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Send a request if it is due."""
        wake_ns = self.next_wake_ns()
        if wake_ns is None or now_ns < wake_ns:
            return Action()
        request = PingRequest(self._flow, self._sent_count, self._size_bytes, self._protocol)
        self._sent_count += 1
        self._next_ns += self._interval_ns * ((now_ns - wake_ns) // self._interval_ns + 1)
        return Action(
            (Datagram(self._destination, self._size_bytes, self._flow, request.number, request, self._protocol),)
        )


class EchoResponder:
    """Replies to every request immediately."""

    def next_wake_ns(self) -> None:
        """Return None: it wakes only when a request arrives."""

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Send a reply to each received request."""
        requests = [
            (datagram.source, datagram.payload)
            for datagram in received_datagrams
            if isinstance(datagram.payload, PingRequest)
        ]
        return Action(
            [
                Datagram(source, request.size_bytes, request.flow + REPLY, request.number, None, request.protocol)
                for source, request in requests
            ]
        )


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message of a bag.

    Attributes:
        at_ns: Time from the beginning of the bag to the recording of the message.
        size_bytes: Serialized size of the message.
    """

    at_ns: int
    size_bytes: int

    def __deepcopy__(self, memo: dict[int, Any]) -> "BagMessage":
        return self  # it is immutable, so a run and its forks share it


def generated_bag(
    draws: RandomStream, *, length_ns: int, rate_hz: float, size_bytes: int, jitter_ns: int
) -> list[BagMessage]:
    """Return a bag of messages that have the same size, at a constant rate.

    Each message is recorded after a random delay, but not before the previous message.

    Args:
        draws: Random numbers, one for each message.
        length_ns: Length of the recording.
        rate_hz: Messages per second.
        size_bytes: Size of each message.
        jitter_ns: Largest delay of a message; delays are uniformly distributed.
    """
    times_ns: list[int] = []
    for number in range(round(length_ns / 1e9 * rate_hz)):
        late_ns = int(draws.draw(number) * (jitter_ns + 1))
        times_ns.append(max([round(number / rate_hz * 1e9) + late_ns, *times_ns[-1:]]))
    return [BagMessage(at_ns, size_bytes) for at_ns in times_ns]


class Playback:
    """Sends the messages of a bag at their recorded times.

    Args:
        flow: Name of the flow.
        destination: Name of the receiving agent.
        bag: The messages, in order of time.
        begin_ns: Time at which playback begins.
        protocol: Name of the transport.
    """

    def __init__(
        self, flow: str, destination: str, bag: Sequence[BagMessage], *, begin_ns: int = 0, protocol: str = "udp"
    ) -> None:
        self._flow = flow
        self._destination = destination
        self._bag = tuple(bag)
        self._begin_ns = begin_ns
        self._protocol = protocol
        self._sent_count = 0

    def next_wake_ns(self) -> int | None:
        """Return the time of the next message, or None at the end of the bag."""
        return self._begin_ns + self._bag[self._sent_count].at_ns if self._sent_count < len(self._bag) else None

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Send all messages that are due."""
        datagrams = []
        while (wake_ns := self.next_wake_ns()) is not None and wake_ns <= now_ns:
            size_bytes = self._bag[self._sent_count].size_bytes
            datagrams.append(
                Datagram(self._destination, size_bytes, self._flow, self._sent_count, None, self._protocol)
            )
            self._sent_count += 1
        return Action(datagrams)


def file_pieces(size_bytes: int, piece_bytes: int) -> list[BagMessage]:
    """Return a file as messages of at most `piece_bytes` that are all due at the same time."""
    full_pieces, last_bytes = divmod(size_bytes, piece_bytes)
    sizes_bytes = [piece_bytes] * full_pieces + ([last_bytes] if last_bytes else [])
    return [BagMessage(0, size) for size in sizes_bytes]

"""Programs that send recorded data: a bag message by message, or a file in one burst."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sim_backends.cosim.federates import Action
from sim_backends.network.packets import Datagram, Received
from sim_backends.radio.random_streams import RandomStream
from sim_backends.world.motion import State


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message of a bag.

    Attributes:
        at_ns: Time of recording, from the beginning of the bag.
        size_bytes: Its serialized size.
    """

    at_ns: int
    size_bytes: int

    def __deepcopy__(self, memo: dict[int, Any]) -> "BagMessage":
        return self  # it is immutable, so a run and its forks share it


def recorded(
    draws: RandomStream, *, length_ns: int, rate_hz: float, size_bytes: int, jitter_ns: int
) -> list[BagMessage]:
    """Return a bag of messages of one size and rate; each is recorded with a random delay, and the order is kept.

    Args:
        draws: One draw for each message.
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
        self._sent = 0

    def next_wake_ns(self) -> int | None:
        """Return the time of the next message, or None at the end of the bag."""
        return self._begin_ns + self._bag[self._sent].at_ns if self._sent < len(self._bag) else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Send all messages that are due."""
        datagrams = []
        while (wake_ns := self.next_wake_ns()) is not None and wake_ns <= now_ns:
            size_bytes = self._bag[self._sent].size_bytes
            datagrams.append(Datagram(self._destination, size_bytes, self._flow, self._sent, None, self._protocol))
            self._sent += 1
        return Action(datagrams)


def pieces(size_bytes: int, piece_bytes: int) -> list[BagMessage]:
    """Return a file as messages of at most `piece_bytes` that are all due at the same time."""
    whole, rest = divmod(size_bytes, piece_bytes)
    return [BagMessage(0, size) for size in (*[piece_bytes] * whole, *([rest] if rest else []))]

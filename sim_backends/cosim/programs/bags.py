"""Programs that send what was recorded before: a bag message by message, or a file at once."""

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
        at_ns: When it was recorded, counted from the bag's beginning.
        size_bytes: Its size, serialized.
    """

    at_ns: int
    size_bytes: int

    def __deepcopy__(self, memo: dict[int, Any]) -> "BagMessage":
        return self  # it never changes, so a run and its forks may share it


def recorded(
    draws: RandomStream, *, length_ns: int, rate_hz: float, size_bytes: int, jitter_ns: int
) -> list[BagMessage]:
    """Return a bag of messages of one size and rate, each recorded a little late, and none before the one before.

    Args:
        draws: One draw for each message.
        length_ns: How long was recorded.
        rate_hz: Messages per second.
        size_bytes: Of each.
        jitter_ns: Most that a message is late, evenly distributed.
    """
    times_ns: list[int] = []
    for number in range(round(length_ns / 1e9 * rate_hz)):
        late_ns = int(draws.draw(number) * (jitter_ns + 1))
        times_ns.append(max([round(number / rate_hz * 1e9) + late_ns, *times_ns[-1:]]))
    return [BagMessage(at_ns, size_bytes) for at_ns in times_ns]


class Playback:
    """Sends the messages of a bag at the times at which they were recorded.

    Args:
        flow: Name of the flow.
        destination: Who gets them.
        bag: The messages, in order of time.
        begin_ns: When playing begins.
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
        self._played = 0

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        return self._begin_ns + self._bag[self._played].at_ns if self._played < len(self._bag) else None

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`: what is due by now is sent now."""
        datagrams = []
        while (wake_ns := self.next_wake_ns()) is not None and wake_ns <= now_ns:
            size_bytes = self._bag[self._played].size_bytes
            datagrams.append(Datagram(self._destination, size_bytes, self._flow, self._played, None, self._protocol))
            self._played += 1
        return Action(datagrams)


def pieces(size_bytes: int, piece_bytes: int) -> list[BagMessage]:
    """Return a file as messages that are all due at once, none larger than `piece_bytes`."""
    whole, rest = divmod(size_bytes, piece_bytes)
    return [BagMessage(0, size) for size in (*[piece_bytes] * whole, *([rest] if rest else []))]

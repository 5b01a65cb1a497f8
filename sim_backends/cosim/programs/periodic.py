"""A program that publishes its agent's state at a fixed rate."""

from collections.abc import Sequence

from sim_backends.cosim.federates import Action
from sim_backends.network.packets import Datagram, Received
from sim_backends.world.motion import State


class Periodic:
    """Publishes its agent's state at a fixed rate.

    Args:
        flow: Name of the flow.
        destination: Name of the receiving agent.
        period_ns: Time between packets.
        size_bytes: Size of each packet.
        first_ns: Time of the first packet.
        stop_ns: Time from which on nothing is sent; None for never.
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
        """Return the time of the next packet, or None after `stop_ns`."""
        return None if self._stop_ns is not None and self._next_ns >= self._stop_ns else self._next_ns

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Send a packet if it is due."""
        wake_ns = self.next_wake_ns()
        if wake_ns is None or now_ns < wake_ns:
            return Action()
        datagram = Datagram(self._destination, self._size_bytes, self._flow, self._number, own_state, self._protocol)
        self._number += 1
        # After a clock was set ahead, missed packets are skipped.
        self._next_ns += self._period_ns * ((now_ns - wake_ns) // self._period_ns + 1)
        return Action((datagram,))

"""The split of wall time: what agents, network and exchange took, and in what time a federate itself only waited."""

from collections.abc import Iterable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Waits(Protocol):
    """A federate or program that waits itself: for another process, a machine, a fault.

    Attributes:
        waited_s: For how long it has, in seconds of wall time.
    """

    waited_s: float


class WallTime:
    """Takes out of each part in what time a federate of it only waited.

    Args:
        agents: Physics and programs.
        network: The network.
    """

    def __init__(self, *, agents: Iterable[object], network: Iterable[object]) -> None:
        parts = {"agents": agents, "network": network}
        self._waiting = [(part, one) for part, ones in parts.items() for one in ones if isinstance(one, Waits)]
        self._waited_s = [one.waited_s for _, one in self._waiting]

    def split(self, agents_s: float, network_s: float, exchange_s: float) -> dict[str, float]:
        """Return the wall time of a window by part, from what its calls took."""
        parts = {"agents": agents_s, "network": network_s, "exchange": exchange_s, "wait": 0.0}
        if self._waiting:
            for number, (part, one) in enumerate(self._waiting):
                waited_s = one.waited_s - self._waited_s[number]
                self._waited_s[number] = one.waited_s
                parts[part] -= waited_s
                parts["wait"] += waited_s
        return parts

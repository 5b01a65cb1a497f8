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
    """Splits wall time by part, and takes out of each in what time a federate of it only waited.

    Args:
        total_s: Takes the sums, in seconds by part, as `no_wall_s` has them.
        agents: Physics and programs.
        network: The network.
    """

    def __init__(self, total_s: dict[str, float], *, agents: Iterable[object], network: Iterable[object]) -> None:
        self._total_s = total_s
        parts = {"agents": agents, "network": network}
        self._waiting = [(part, one) for part, ones in parts.items() for one in ones if isinstance(one, Waits)]
        self._added_s = [one.waited_s for _, one in self._waiting]
        self._split_s = list(self._added_s)

    def add(self, agents_s: float, network_s: float, whole_s: float) -> None:
        """Add many windows to the sums, from what their calls took and what they took as a whole."""
        self._total_s["agents"] += agents_s
        self._total_s["network"] += network_s
        self._total_s["exchange"] += whole_s - agents_s - network_s
        self._take_waits(self._total_s, self._added_s)

    def split(self, agents_s: float, network_s: float, whole_s: float) -> dict[str, float]:
        """Return the wall time of one window by part, from what its calls took and what it took as a whole."""
        parts = {"agents": agents_s, "network": network_s, "exchange": whole_s - agents_s - network_s, "wait": 0.0}
        self._take_waits(parts, self._split_s)
        return parts

    def _take_waits(self, wall_s: dict[str, float], taken_s: list[float]) -> None:
        for number, (part, one) in enumerate(self._waiting):
            waited_s = one.waited_s - taken_s[number]
            taken_s[number] = one.waited_s
            wall_s[part] -= waited_s
            wall_s["wait"] += waited_s

"""Wall time of a run by part: agents, network, exchange, and wait."""

import time
from collections.abc import Iterable, Sequence
from typing import Literal, Protocol, runtime_checkable


@runtime_checkable
class Waits(Protocol):
    """A federate or program that waits in wall time: for another process, a device, or a fault.

    It raises `AnswerTimeoutError` if it waits for longer than its deadline.

    Attributes:
        waited_s: Total time that it has waited, in seconds of wall time.
    """

    waited_s: float


class WallTime:
    """Stopwatch that adds each lap to one part of the wall time.

    Time that a federate of the part only waited is added to `wait` instead.

    Args:
        total_s: Receives the sums, in seconds by part, whenever `window` is called.
        agents: Physics and programs.
        network: The network.
    """

    def __init__(self, total_s: dict[str, float], *, agents: Iterable[object], network: Iterable[object]) -> None:
        self._total_s = total_s
        self._waiting: dict[str, Sequence[Waits]] = {
            "agents": [federate for federate in agents if isinstance(federate, Waits)],
            "network": [federate for federate in network if isinstance(federate, Waits)],
            "exchange": (),
        }
        self._waited_s = {part: self._sum_s(part) for part in self._waiting}
        self._spent_s = dict.fromkeys(total_s, 0.0)
        self._lap_s = time.perf_counter()

    def start(self) -> None:
        """Begin a lap; the time since the last lap belongs to no part."""
        self._lap_s = time.perf_counter()

    def lap(self, part: Literal["agents", "network", "exchange"]) -> None:
        """Add the time since the last lap to a part."""
        now_s = time.perf_counter()
        self._spent_s[part] += now_s - self._lap_s
        self._lap_s = now_s
        if self._waiting[part]:
            waited_s = self._sum_s(part)
            new_s = waited_s - self._waited_s[part]
            self._waited_s[part] = waited_s
            self._spent_s[part] -= new_s
            self._spent_s["wait"] += new_s

    def window(self) -> dict[str, float]:
        """Return the wall time by part since the last call, and add it to the sums."""
        spent_s, self._spent_s = self._spent_s, dict.fromkeys(self._spent_s, 0.0)
        for part, part_s in spent_s.items():
            self._total_s[part] += part_s
        return spent_s

    def _sum_s(self, part: str) -> float:
        return sum(federate.waited_s for federate in self._waiting[part])

"""Measures the wall time of each part of a run, limits the rate of reports, and delays an answer as a fault."""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Final, Literal, Protocol, TypeVar, cast, runtime_checkable

from sim_backends.cosim.federates import AnswerTimeoutError, NetworkFederate, PhysicsFederate, Program

_PROGRESS_EVERY_S: Final = 0.2
"""Shortest time between two progress reports, in wall time."""

Progress = Callable[[int, float], None]
"""Called with the simulated nanoseconds so far, and the wall seconds since the run was started or continued."""


@runtime_checkable
class HasWaitingTime(Protocol):
    """A federate (physics or network) or program that waits in wall time: for another process, a device, or a fault.

    It raises `AnswerTimeoutError` if it waits for longer than its deadline.

    Attributes:
        waited_s: Total time that it has waited, in seconds of wall time.
    """

    waited_s: float


class WallTime:
    """Stopwatch that adds each lap to one part of the wall time.

    Time in which a federate only waited is added to `wait`, not to the part of the federate.

    Args:
        total_s: The sums in seconds, by part; each call of `end_window` updates them.
        agents: Physics and programs.
        network: The network.
    """

    def __init__(self, total_s: dict[str, float], *, agents: Iterable[object], network: Iterable[object]) -> None:
        self._total_s = total_s
        self._waiting_federates: dict[str, Sequence[HasWaitingTime]] = {
            "agents": [federate for federate in agents if isinstance(federate, HasWaitingTime)],
            "network": [federate for federate in network if isinstance(federate, HasWaitingTime)],
            "exchange": (),
        }
        self._waited_s = {part: self._total_waited_s(part) for part in self._waiting_federates}
        self._spent_s = dict.fromkeys(total_s, 0.0)
        self._lap_start_s = time.perf_counter()

    def start(self) -> None:
        """Start a lap; the time since the last lap is not added to any part."""
        self._lap_start_s = time.perf_counter()

    def lap(self, part: Literal["agents", "network", "exchange"]) -> None:
        """Add the time since the last lap to a part."""
        now_s = time.perf_counter()
        self._spent_s[part] += now_s - self._lap_start_s
        self._lap_start_s = now_s
        if self._waiting_federates[part]:
            waited_s = self._total_waited_s(part)
            new_s = waited_s - self._waited_s[part]
            self._waited_s[part] = waited_s
            self._spent_s[part] -= new_s
            self._spent_s["wait"] += new_s

    def end_window(self) -> dict[str, float]:
        """Return the wall time by part since the last call, and add it to the sums."""
        spent_s, self._spent_s = self._spent_s, dict.fromkeys(self._spent_s, 0.0)
        for part, part_s in spent_s.items():
            self._total_s[part] += part_s
        return spent_s

    def _total_waited_s(self, part: str) -> float:
        return sum(federate.waited_s for federate in self._waiting_federates[part])


DEADLINE_S: Final = 30.0
"""Default deadline of an answer, in seconds of wall time."""

Federate = TypeVar("Federate", bound=PhysicsFederate | NetworkFederate | Program)


class Stall:
    """Delays one answer of a federate or program, as a fault.

    Args:
        at_ns: Simulated time of the stall: the first request for this time or a later one is delayed.
        wall_s: Duration, in seconds of wall time.
        limit_s: Deadline of an answer, in seconds of wall time; None for no deadline.

    Attributes:
        waited_s: Total time that it has waited, in seconds of wall time.
    """

    def __init__(self, at_ns: int, wall_s: float, limit_s: float | None = None) -> None:
        self._at_ns = at_ns
        self._wall_s = wall_s
        self._limit_s = limit_s
        self._is_over = False
        self.waited_s = 0.0

    def wait(self, now_ns: int) -> None:
        """Wait if this is the first request for `at_ns` or later.

        Raises:
            AnswerTimeoutError: The wait is longer than the deadline, and the deadline has passed.
        """
        if self._is_over or now_ns < self._at_ns:
            return
        self._is_over = True
        if self._limit_s is not None and self._wall_s > self._limit_s:
            self._sleep(self._limit_s)
            raise AnswerTimeoutError(self._limit_s)
        self._sleep(self._wall_s)

    def _sleep(self, wall_s: float) -> None:
        start_s = time.perf_counter()
        time.sleep(wall_s)
        self.waited_s += time.perf_counter() - start_s


_REQUESTS: Final = ("advance", "wake")
"""Methods of federates and programs whose first argument is a simulated time."""


class _StallingFederate:
    """Wraps a federate or program, and delays its answer to the first request of a stall."""

    def __init__(self, federate: object, stall: Stall) -> None:
        self._federate = federate
        self._stall = stall

    @property
    def waited_s(self) -> float:
        """The waiting time of the stall and of the federate itself (`HasWaitingTime`)."""
        return self._stall.waited_s + (self._federate.waited_s if isinstance(self._federate, HasWaitingTime) else 0.0)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (depends on the federate)
        if name.startswith("_"):  # `copy.deepcopy` reads attributes of a copy before `_federate` is set
            raise AttributeError(name)
        attribute = getattr(self._federate, name)
        return partial(self._delayed, attribute) if name in _REQUESTS else attribute

    def _delayed(self, request: Callable[..., Any], now_ns: int, *arguments: object) -> Any:  # noqa: ANN401 (as above)
        self._stall.wait(now_ns)
        return request(now_ns, *arguments)


def with_stall(federate: Federate, stall: Stall) -> Federate:
    """Return a federate or program with a delayed answer.

    Args:
        federate: The federate or program.
        stall: The time and the duration of the delay.
    """
    return cast("Federate", _StallingFederate(federate, stall))


def rate_limited(progress: Progress) -> Callable[[int], None]:
    """Return a function of the simulated time that calls `progress` at most every 0.2 s of wall time."""
    start_s = last_report_s = time.perf_counter()

    def report(now_ns: int) -> None:
        nonlocal last_report_s
        wall_s = time.perf_counter()
        if wall_s - last_report_s >= _PROGRESS_EVERY_S:
            last_report_s = wall_s
            progress(now_ns, wall_s - start_s)

    return report

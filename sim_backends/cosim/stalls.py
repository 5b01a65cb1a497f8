"""Fault `stalled-federate`: a federate that answers one request late, in wall time."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeVar, cast

from sim_backends.cosim.federate_errors import AnswerTimeoutError
from sim_backends.cosim.federates import NetworkFederate, PhysicsFederate, Program
from sim_backends.cosim.wall_time import Waits

DEADLINE_S: Final = 30.0
"""Default deadline of an answer, in seconds of wall time."""

Federate = TypeVar("Federate", bound=PhysicsFederate | NetworkFederate | Program)


class Stall:
    """Delays one answer.

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
        started_s = time.perf_counter()
        time.sleep(wall_s)
        self.waited_s += time.perf_counter() - started_s


_REQUESTS: Final = ("advance", "wake")
"""Methods of federates and programs whose first argument is a simulated time."""


class _Stalled:
    def __init__(self, federate: object, stall: Stall) -> None:
        self._federate = federate
        self._stall = stall

    @property
    def waited_s(self) -> float:
        """The waiting time of the stall and of the federate itself (`wall_time.Waits`)."""
        return self._stall.waited_s + (self._federate.waited_s if isinstance(self._federate, Waits) else 0.0)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (depends on the federate)
        if name.startswith("_"):  # an unfinished copy has no federate yet
            raise AttributeError(name)
        attribute = getattr(self._federate, name)
        return partial(self._delayed, attribute) if name in _REQUESTS else attribute

    def _delayed(self, request: Callable[..., Any], now_ns: int, *rest: object) -> Any:  # noqa: ANN401 (as above)
        self._stall.wait(now_ns)
        return request(now_ns, *rest)


def stalled(federate: Federate, stall: Stall) -> Federate:
    """Return a federate or program with a delayed answer.

    Args:
        federate: The federate or program.
        stall: When it stalls, and for how long.
    """
    return cast("Federate", _Stalled(federate, stall))

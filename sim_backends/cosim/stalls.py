"""Fault `stalled-federate`: a party that answers late, in wall time, once, at a simulated time."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeVar, cast

from sim_backends.cosim.federate_errors import AnswerTimeoutError
from sim_backends.cosim.federates import NetworkFederate, PhysicsFederate, Program
from sim_backends.cosim.wall_time import Waits

DEADLINE_S: Final = 30.0
"""Default deadline of an answer, in seconds of wall time."""

Party = TypeVar("Party", bound=PhysicsFederate | NetworkFederate | Program)


class Stall:
    """Delays one answer.

    Args:
        at_ns: Simulated time from which on it waits: the first question about this time or a later one waits.
        wall_s: Duration, in seconds of wall time.
        limit_s: Deadline of an answer, in seconds of wall time; None for no deadline.

    Attributes:
        waited_s: Total time that it has waited, in seconds of wall time.
    """

    def __init__(self, at_ns: int, wall_s: float, limit_s: float | None = None) -> None:
        self._at_ns = at_ns
        self._wall_s = wall_s
        self._limit_s = limit_s
        self._over = False
        self.waited_s = 0.0

    def wait(self, now_ns: int) -> None:
        """Wait if this is the first question about `at_ns` or later.

        Raises:
            AnswerTimeoutError: The wait is longer than the deadline, and the deadline has passed.
        """
        if self._over or now_ns < self._at_ns:
            return
        self._over = True
        if self._limit_s is not None and self._wall_s > self._limit_s:
            self._sleep(self._limit_s)
            raise AnswerTimeoutError(self._limit_s)
        self._sleep(self._wall_s)

    def _sleep(self, wall_s: float) -> None:
        begun_s = time.perf_counter()
        time.sleep(wall_s)
        self.waited_s += time.perf_counter() - begun_s


_QUESTIONS: Final = ("advance", "wake")
"""What federates and programs are asked at a simulated time, which comes first."""


class _Stalled:
    def __init__(self, party: object, stall: Stall) -> None:
        self._party = party
        self._stall = stall

    @property
    def waited_s(self) -> float:
        """See `wall_time.Waits`; what it stalls may wait, too."""
        return self._stall.waited_s + (self._party.waited_s if isinstance(self._party, Waits) else 0.0)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (whatever the party has)
        if name.startswith("_"):  # a copy that is being made has no party yet
            raise AttributeError(name)
        found = getattr(self._party, name)
        return partial(self._ask, found) if name in _QUESTIONS else found

    def _ask(self, question: Callable[..., Any], now_ns: int, *rest: object) -> Any:  # noqa: ANN401 (as above)
        self._stall.wait(now_ns)
        return question(now_ns, *rest)


def stalled(party: Party, stall: Stall) -> Party:
    """Return a federate, or a program, that stalls.

    Args:
        party: What it is otherwise.
        stall: When, and for how long.
    """
    return cast("Party", _Stalled(party, stall))

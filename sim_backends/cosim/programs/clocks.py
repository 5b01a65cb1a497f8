"""Programs whose computer's clock is wrong: they wake and stamp by it, and know no other."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.federates import Action, Program, next_send_ns
from sim_backends.network.packets import Received
from sim_backends.world.motion import State

_BILLION: Final = 10**9


@dataclass(frozen=True, slots=True)
class AgentClock:
    """A clock that is right but for one stretch of time.

    Attributes:
        begin_ns: From when on it is wrong.
        end_ns: When it is set right again; None for never.
        offset_ns: By how much it is fast at `begin_ns`; below 0, slow.
        rate_ppb: By how much more it goes fast, in nanoseconds per second.

    Raises:
        ConfigurationError: It would stand, or go back.
    """

    begin_ns: int = 0
    end_ns: int | None = None
    offset_ns: int = 0
    rate_ppb: int = 0

    def __post_init__(self) -> None:
        if self.rate_ppb <= -_BILLION:
            raise ConfigurationError(
                f"a clock that loses {-self.rate_ppb:,} ns per second stands or goes back: nobody wakes by it",
                remedy="let it lose less than 10^9 ns per second",
            )

    def shows_ns(self, now_ns: int) -> int:
        """Return what it shows at a time."""
        if now_ns < self.begin_ns or (self.end_ns is not None and now_ns >= self.end_ns):
            return now_ns
        return now_ns + self.offset_ns + (now_ns - self.begin_ns) * self.rate_ppb // _BILLION

    def first_ns(self, shown_ns: int) -> int:
        """Return when it first shows a time, or one after it."""
        if shown_ns < self.begin_ns:
            return shown_ns
        # After n ns of being wrong it has gone on by floor(n (1 + rate)): the first n for which that is enough.
        missing_ns = shown_ns - self.begin_ns - self.offset_ns
        since_ns = max(-(-missing_ns * _BILLION // (_BILLION + self.rate_ppb)), 0)
        wrong_until_ns = self.begin_ns + since_ns
        if self.end_ns is None or wrong_until_ns < self.end_ns:
            return wrong_until_ns
        return max(shown_ns, self.end_ns)


@dataclass(frozen=True, slots=True)
class _Stamped:
    payload: Any
    sent_ns: int


class Clocked:
    """A program that knows the time from its computer's clock only, so that its stamps are of that clock.

    Where one agent's clock is wrong, the programs of all agents are clocked, so that stamps are read.

    Args:
        program: The program.
        clock: The clock.
    """

    def __init__(self, program: Program, clock: AgentClock) -> None:
        self._program = program
        self._clock = clock

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        shown_ns = self._program.next_wake_ns()
        return None if shown_ns is None else self._clock.first_ns(shown_ns)

    def next_send_ns(self) -> int | None:
        """See `federates.next_send_ns`."""
        shown_ns = next_send_ns(self._program)
        return None if shown_ns is None else self._clock.first_ns(shown_ns)

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """See `Program.wake`."""
        shown_ns = self._clock.shows_ns(now_ns)
        action = self._program.wake(shown_ns, own, [self._read(one) for one in received])
        stamped = [replace(one, payload=_Stamped(one.payload, shown_ns)) for one in action.datagrams]
        return Action(stamped, action.command)

    def _read(self, received: Received) -> Received:
        stamped: _Stamped = received.payload
        arrived_ns = self._clock.shows_ns(received.arrived_ns)
        return Received(received.source, stamped.payload, stamped.sent_ns, arrived_ns)

"""Programs whose computer has a wrong clock: it determines their timers and time stamps."""

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
    """A clock that is correct except during one interval.

    Attributes:
        begin_ns: Beginning of the interval.
        end_ns: End of the interval, when the clock is set right again; None for never.
        offset_ns: How far it is ahead at `begin_ns`; negative if it is behind.
        rate_ppb: By how much it gains, in nanoseconds per second.

    Raises:
        ConfigurationError: The clock would stop or run backwards.
    """

    begin_ns: int = 0
    end_ns: int | None = None
    offset_ns: int = 0
    rate_ppb: int = 0

    def __post_init__(self) -> None:
        if self.rate_ppb <= -_BILLION:
            raise ConfigurationError(
                f"a clock that loses {-self.rate_ppb:,} ns per second stops or runs backwards, and no timer fires",
                remedy="let it lose less than 10^9 ns per second",
            )

    def reading_ns(self, now_ns: int) -> int:
        """Return its reading at a time."""
        if now_ns < self.begin_ns or (self.end_ns is not None and now_ns >= self.end_ns):
            return now_ns
        return now_ns + self.offset_ns + (now_ns - self.begin_ns) * self.rate_ppb // _BILLION

    def first_ns(self, shown_ns: int) -> int:
        """Return the first time at which its reading is `shown_ns` or later."""
        if shown_ns < self.begin_ns:
            return shown_ns
        # After n ns in the interval it has advanced by floor(n (1 + rate)): find the smallest sufficient n.
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
    """A program whose only clock is its computer's, which also stamps its datagrams.

    If the clock of one agent is wrong, the programs of all agents are wrapped, so that all can read the time stamps.

    Args:
        program: The program.
        clock: The clock.
    """

    def __init__(self, program: Program, clock: AgentClock) -> None:
        self._program = program
        self._clock = clock

    def next_wake_ns(self) -> int | None:
        """Return the true time at which the program's timer fires."""
        shown_ns = self._program.next_wake_ns()
        return None if shown_ns is None else self._clock.first_ns(shown_ns)

    def next_send_ns(self) -> int | None:
        """Return the true time before which the program does not send."""
        shown_ns = next_send_ns(self._program)
        return None if shown_ns is None else self._clock.first_ns(shown_ns)

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:
        """Wake the program at the clock's reading, and stamp its datagrams with it."""
        shown_ns = self._clock.reading_ns(now_ns)
        action = self._program.wake(shown_ns, own_state, [self._unstamped(datagram) for datagram in received])
        stamped = [replace(datagram, payload=_Stamped(datagram.payload, shown_ns)) for datagram in action.datagrams]
        return Action(stamped, action.command)

    def _unstamped(self, received: Received) -> Received:
        stamped: _Stamped = received.payload
        arrived_ns = self._clock.reading_ns(received.arrived_ns)
        return Received(received.source, stamped.payload, stamped.sent_ns, arrived_ns)

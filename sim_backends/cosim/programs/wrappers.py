"""Programs that wrap other programs: several on one agent, outages, and clocks with an error."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.federates import Action, Program, next_send_ns
from sim_backends.network.packets import ReceivedDatagram
from sim_backends.world.motion import State


class CombinedProgram:
    """Combines programs of one agent. Each program wakes at the times that it requests, and receives all datagrams.

    Args:
        programs: The programs; if several steer at the same time, the command of the last one applies.
    """

    def __init__(self, programs: Sequence[Program]) -> None:
        self._programs = tuple(programs)

    def next_wake_ns(self) -> int | None:
        """Return the earliest time of any program, or None if no timer is set."""
        times_ns = (program.next_wake_ns() for program in self._programs)
        return min((at_ns for at_ns in times_ns if at_ns is not None), default=None)

    def next_send_ns(self) -> int | None:
        """Return the earliest time of any program (see `next_send_ns`), or None if all send only in reply."""
        times_ns = (next_send_ns(program) for program in self._programs)
        return min((at_ns for at_ns in times_ns if at_ns is not None), default=None)

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:
        """Wake the programs that are due, or all if a datagram has arrived."""
        actions = [
            program.wake(now_ns, own_state, received_datagrams)
            for program in self._programs
            if received_datagrams or _is_due(program, now_ns)
        ]
        commands = [action.command for action in actions if action.command is not None]
        datagrams = tuple(datagram for action in actions for datagram in action.datagrams)
        return Action(datagrams, commands[-1] if commands else None)


def _is_due(program: Program, now_ns: int) -> bool:
    wake_ns = program.next_wake_ns()
    return wake_ns is not None and wake_ns <= now_ns


class Outage:
    """A program that is off during an interval: it receives and sends nothing, and its body gets a command to stop.

    After the interval it continues as if all its packets in the interval had been lost.

    Args:
        program: The program.
        begin_ns: Start of the interval.
        end_ns: End of the interval; None if the program stays off.
        stop: Command that stops the body; None if there is no body to stop.
    """

    def __init__(self, program: Program, begin_ns: int, end_ns: int | None, stop: Any = None) -> None:  # noqa: ANN401
        self._program = program
        self._begin_ns = begin_ns
        self._end_ns = end_ns
        self._stop = stop
        self._is_stopped = False

    def next_wake_ns(self) -> int | None:
        """Return the program's next wake time, or None if no timer is set.

        Before the outage has stopped the body, the start of the outage is returned if it is earlier.
        """
        wake_ns = self._program.next_wake_ns()
        if self._is_stopped:
            return wake_ns
        return self._begin_ns if wake_ns is None else min(wake_ns, self._begin_ns)

    def next_send_ns(self) -> int | None:
        """Return the program's next send time (see `next_send_ns`), also during the outage."""
        return next_send_ns(self._program)

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:
        """Wake the program; during the outage, discard its action, and stop the body once."""
        is_off = self._begin_ns <= now_ns and (self._end_ns is None or now_ns < self._end_ns)
        if not is_off:
            return self._program.wake(now_ns, own_state, received_datagrams)
        wake_ns = self._program.next_wake_ns()
        if wake_ns is not None and wake_ns <= now_ns:
            self._program.wake(now_ns, own_state, ())
        command, self._is_stopped = None if self._is_stopped else self._stop, True
        return Action(command=command)


_BILLION: Final = 10**9
"""Nanoseconds per second."""


@dataclass(frozen=True, slots=True)
class AgentClock:
    """A clock that is correct except during one interval.

    Attributes:
        begin_ns: Beginning of the interval.
        end_ns: End of the interval, when the clock is corrected; None for never.
        offset_ns: Offset of the clock at `begin_ns`, positive if it is ahead.
        rate_ppb: Rate error of the clock in nanoseconds per second, positive if it is fast.

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
                remedy="set a clock that loses less than 10^9 ns per second",
            )

    def reading_ns(self, now_ns: int) -> int:
        """Return the reading of the clock at a time."""
        if now_ns < self.begin_ns or (self.end_ns is not None and now_ns >= self.end_ns):
            return now_ns
        return now_ns + self.offset_ns + (now_ns - self.begin_ns) * self.rate_ppb // _BILLION

    def first_ns(self, reading_ns: int) -> int:
        """Return the first time at which the reading of the clock is `reading_ns` or later."""
        if reading_ns < self.begin_ns:
            return reading_ns
        # After n ns in the interval the clock has advanced by floor(n (1 + rate)). This finds the smallest sufficient
        # n; the two minus signs make the division round up.
        missing_ns = reading_ns - self.begin_ns - self.offset_ns
        since_ns = max(-(-missing_ns * _BILLION // (_BILLION + self.rate_ppb)), 0)
        time_in_interval_ns = self.begin_ns + since_ns
        if self.end_ns is None or time_in_interval_ns < self.end_ns:
            return time_in_interval_ns
        return max(reading_ns, self.end_ns)


@dataclass(frozen=True, slots=True)
class _StampedPayload:
    """A payload with the time of sending, as read from the sender's clock."""

    payload: Any
    sent_ns: int


class ProgramWithClock:
    """A program that uses only the clock of its computer, including for the time stamps of its datagrams.

    If the clock of one agent is wrong, the programs of all agents are wrapped, so that all can read the time stamps.

    Args:
        program: The program.
        clock: The clock.
    """

    def __init__(self, program: Program, clock: AgentClock) -> None:
        self._program = program
        self._clock = clock

    def next_wake_ns(self) -> int | None:
        """Return the true time at which the program's timer fires, or None if no timer is set."""
        reading_ns = self._program.next_wake_ns()
        return None if reading_ns is None else self._clock.first_ns(reading_ns)

    def next_send_ns(self) -> int | None:
        """Return the true time before which the program sends only in reply, or None if it always does."""
        reading_ns = next_send_ns(self._program)
        return None if reading_ns is None else self._clock.first_ns(reading_ns)

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:
        """Wake the program at the clock's reading, and stamp its datagrams with it."""
        reading_ns = self._clock.reading_ns(now_ns)
        action = self._program.wake(
            reading_ns, own_state, [self._unstamped(datagram) for datagram in received_datagrams]
        )
        stamped_datagrams = [
            replace(datagram, payload=_StampedPayload(datagram.payload, reading_ns)) for datagram in action.datagrams
        ]
        return Action(stamped_datagrams, action.command)

    def _unstamped(self, received_datagram: ReceivedDatagram) -> ReceivedDatagram:
        """Return the datagram as the program receives it.

        It has the original payload, the time of sending by the sender's clock, and the time of arrival by the clock
        of this program.
        """
        stamped_payload: _StampedPayload = received_datagram.payload
        arrived_ns = self._clock.reading_ns(received_datagram.arrived_ns)
        return ReceivedDatagram(
            received_datagram.source, stamped_payload.payload, stamped_payload.sent_ns, arrived_ns
        )

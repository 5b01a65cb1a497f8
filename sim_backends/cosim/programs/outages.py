"""Programs on a computer that is switched off for a time."""

from collections.abc import Sequence
from typing import Any

from sim_backends.cosim.federates import Action, Program, next_send_ns
from sim_backends.network.packets import Received
from sim_backends.world.motion import State


class Outage:
    """A program that is off for a time: it receives and sends nothing, and its body gets a command to stop.

    When it is on again, it continues as if all its packets in that time had been lost.

    Args:
        program: The program.
        begin_ns: Time when it goes off.
        end_ns: Time when it is on again; None for never.
        stop: Command that stops the body; None if there is no body to stop.
    """

    def __init__(self, program: Program, begin_ns: int, end_ns: int | None, stop: Any = None) -> None:  # noqa: ANN401
        self._program = program
        self._begin_ns = begin_ns
        self._end_ns = end_ns
        self._stop = stop
        self._is_stopped = False

    def next_wake_ns(self) -> int | None:
        """Return the program's next time; before the body has been stopped, at the latest the beginning."""
        wake_ns = self._program.next_wake_ns()
        return wake_ns if self._is_stopped else min(self._begin_ns, self._begin_ns if wake_ns is None else wake_ns)

    def next_send_ns(self) -> int | None:
        """Return the program's next time of sending."""
        return next_send_ns(self._program)

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:
        """Wake the program; during the outage, discard its action, and stop the body once."""
        is_off = self._begin_ns <= now_ns and (self._end_ns is None or now_ns < self._end_ns)
        if not is_off:
            return self._program.wake(now_ns, own_state, received)
        wake_ns = self._program.next_wake_ns()
        if wake_ns is not None and wake_ns <= now_ns:
            self._program.wake(now_ns, own_state, ())
        command, self._is_stopped = None if self._is_stopped else self._stop, True
        return Action(command=command)

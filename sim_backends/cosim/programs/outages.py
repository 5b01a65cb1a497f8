"""Programs on a computer that is off for a while."""

from collections.abc import Sequence
from typing import Any

from sim_backends.cosim.federates import Action, Program, next_send_ns
from sim_backends.network.packets import Received
from sim_backends.world.motion import State


class Outage:
    """A program that is off for a while: it hears and sends nothing, and its body is told to stop.

    When it is on again it goes on as if it had only not heard and not been heard.

    Args:
        program: The program.
        begin_ns: From when on it is off.
        end_ns: When it is on again; None for never.
        stop: Command that stops the body; None where there is none to be told.
    """

    def __init__(self, program: Program, begin_ns: int, end_ns: int | None, stop: Any = None) -> None:  # noqa: ANN401
        self._program = program
        self._begin_ns = begin_ns
        self._end_ns = end_ns
        self._stop = stop
        self._stopped = False

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        wake_ns = self._program.next_wake_ns()
        return wake_ns if self._stopped else min(self._begin_ns, self._begin_ns if wake_ns is None else wake_ns)

    def next_send_ns(self) -> int | None:
        """See `federates.next_send_ns`."""
        return next_send_ns(self._program)

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """See `Program.wake`."""
        off = self._begin_ns <= now_ns and (self._end_ns is None or now_ns < self._end_ns)
        if not off:
            return self._program.wake(now_ns, own, received)
        wake_ns = self._program.next_wake_ns()
        if wake_ns is not None and wake_ns <= now_ns:
            self._program.wake(now_ns, own, ())
        command, self._stopped = None if self._stopped else self._stop, True
        return Action(command=command)

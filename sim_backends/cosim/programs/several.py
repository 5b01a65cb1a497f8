"""Several programs of one agent as one program."""

from collections.abc import Sequence

from sim_backends.cosim.federates import Action, Program, next_send_ns
from sim_backends.network.packets import Received
from sim_backends.world.motion import State


class CombinedProgram:
    """Combines programs of one agent: each wakes at its own times, and all receive all datagrams.

    Args:
        programs: The programs; if several steer at the same time, the command of the last one applies.
    """

    def __init__(self, programs: Sequence[Program]) -> None:
        self._programs = tuple(programs)

    def next_wake_ns(self) -> int | None:
        """Return the earliest time of any program."""
        times_ns = (program.next_wake_ns() for program in self._programs)
        return min((at_ns for at_ns in times_ns if at_ns is not None), default=None)

    def next_send_ns(self) -> int | None:
        """Return the earliest time before which no program sends."""
        times_ns = (next_send_ns(program) for program in self._programs)
        return min((at_ns for at_ns in times_ns if at_ns is not None), default=None)

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:
        """Wake the programs that are due, or all if a datagram has arrived."""
        actions = [
            program.wake(now_ns, own_state, received)
            for program in self._programs
            if received or _is_due(program, now_ns)
        ]
        commands = [action.command for action in actions if action.command is not None]
        datagrams = tuple(datagram for action in actions for datagram in action.datagrams)
        return Action(datagrams, commands[-1] if commands else None)


def _is_due(program: Program, now_ns: int) -> bool:
    wake_ns = program.next_wake_ns()
    return wake_ns is not None and wake_ns <= now_ns

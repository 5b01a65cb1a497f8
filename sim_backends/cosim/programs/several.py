"""Programs that run side by side on one agent."""

from collections.abc import Sequence

from sim_backends.cosim.federates import Action, Program, next_send_ns
from sim_backends.network.packets import Received
from sim_backends.world.motion import State


class Several:
    """Programs of one agent as one: each wakes when it wants to, and all get what arrives.

    Args:
        programs: The programs; where several steer at once, the last one counts.
    """

    def __init__(self, programs: Sequence[Program]) -> None:
        self._programs = tuple(programs)

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        return min((at_ns for one in self._programs if (at_ns := one.next_wake_ns()) is not None), default=None)

    def next_send_ns(self) -> int | None:
        """See `federates.next_send_ns`."""
        return min((at_ns for one in self._programs if (at_ns := next_send_ns(one)) is not None), default=None)

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """See `Program.wake`."""
        actions = [one.wake(now_ns, own, received) for one in self._programs if received or _is_due(one, now_ns)]
        commands = [action.command for action in actions if action.command is not None]
        datagrams = tuple(datagram for action in actions for datagram in action.datagrams)
        return Action(datagrams, commands[-1] if commands else None)


def _is_due(program: Program, now_ns: int) -> bool:
    wake_ns = program.next_wake_ns()
    return wake_ns is not None and wake_ns <= now_ns

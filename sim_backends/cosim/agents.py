"""The agents of a co-simulation: bodies that the physics moves, and programs on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sim_backends.cosim.federates import PhysicsFederate, Program
from sim_backends.network.packets import Datagram, Received
from sim_backends.world.motion import State


@dataclass(frozen=True, slots=True)
class Sent:
    """A datagram that a program sent.

    Attributes:
        at_ns: When.
        source: On which agent it runs.
        datagram: What it sent.
        states: Where the agents were then, at the physics' last own step.
    """

    at_ns: int
    source: str
    datagram: Datagram
    states: Mapping[str, State]


_MOST_AT_ONCE: Final = 1000


class Agents:
    """Lets bodies and programs go on together: a program senses its own body at its own time, whatever the window.

    Args:
        physics: Moves the bodies.
        programs: What runs on each agent; an agent may have none.

    Attributes:
        physics: As given.
    """

    def __init__(self, physics: PhysicsFederate, programs: Mapping[str, Program]) -> None:
        self.physics = physics
        self._programs = dict(sorted(programs.items()))
        self._mail: dict[str, list[Received]] = {}
        self._commands: dict[str, Any] = {}

    def states(self, now_ns: int) -> Mapping[str, State]:
        """Return the states at the last own step of the physics that is not after `now_ns`."""
        commands, self._commands = self._commands, {}
        return self.physics.advance(now_ns, commands)

    def next_wake_ns(self) -> int | None:
        """Return when a program wakes next by itself, None for never."""
        wakes = [wake for program in self._programs.values() if (wake := program.next_wake_ns()) is not None]
        return min(wakes, default=None)

    def hand_over(self, receiver: str, received: Received) -> None:
        """Let the program of an agent get a datagram when it is let go on next."""
        if receiver in self._programs:
            self._mail.setdefault(receiver, []).append(received)

    @property
    def mail(self) -> bool:
        """Whether a program has a datagram that it was not woken for."""
        return bool(self._mail)

    def advance(self, now_ns: int, to_ns: int) -> list[Sent]:
        """Let programs act up to `to_ns`; those with mail act first, now.

        Raises:
            ValueError: A program wakes without end at one time.
        """
        sent: list[Sent] = []
        if self._mail:
            mail, self._mail = self._mail, {}
            sent += self._wake(now_ns, mail)
        woke_ns, turns = -1, 0
        while (wake_ns := self.next_wake_ns()) is not None and wake_ns <= to_ns:
            turns = turns + 1 if wake_ns <= woke_ns else 0
            if turns > _MOST_AT_ONCE:
                raise ValueError(f"a program woke {turns} times at {wake_ns} ns, and goes on")
            woke_ns = wake_ns
            sent += self._wake(
                wake_ns, {name: () for name, one in self._programs.items() if one.next_wake_ns() == wake_ns}
            )
        return sent

    def _wake(self, now_ns: int, mail: Mapping[str, Sequence[Received]]) -> list[Sent]:
        states = self.states(now_ns)
        sent: list[Sent] = []
        for name in sorted(mail):
            action = self._programs[name].wake(now_ns, states[name], mail[name])
            sent.extend(Sent(now_ns, name, datagram, states) for datagram in action.datagrams)
            if action.command is not None:
                self._commands[name] = action.command
        return sent

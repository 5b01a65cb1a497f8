"""The agents of a co-simulation: bodies that the physics moves, and programs on them."""

import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from sim_backends.cosim.federate_errors import FederateError, failed, seconds
from sim_backends.cosim.federates import PhysicsFederate, Program, next_send_ns
from sim_backends.network.packets import Datagram, Received
from sim_backends.world.motion import State


class Sent(NamedTuple):
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

    Raises:
        FederateError: A program failed.

    Attributes:
        physics: As given.
        programs: As given, by name.
        new: Agents that the physics moves since `with_new` was called last, and did not before.
    """

    def __init__(self, physics: PhysicsFederate, programs: Mapping[str, Program]) -> None:
        self.physics = physics
        self.programs = dict(sorted(programs.items()))
        self.new: frozenset[str] = frozenset()
        self._names = frozenset(programs)
        self._at_ns = 0
        self._mail: dict[str, list[Received]] = {}
        self._commands: dict[str, Any] = {}
        self._wakes_ns: dict[str, int] = {}
        self._planned: list[tuple[int, str]] = []
        self._next_ns: int | None = None
        self._plan(self.programs)

    def states(self, now_ns: int) -> Mapping[str, State]:
        """Return the states at the last own step of the physics that is not after `now_ns`.

        Raises:
            FederateError: The physics failed, did not answer in time, or has lost an agent.
        """
        commands = self._commands
        if commands:
            self._commands = {}
        try:
            states = self.physics.advance(now_ns, commands)
        except Exception as error:
            asked = f"advance from {seconds(self._at_ns)} to {seconds(now_ns)}"
            raise failed(error, "physics", asked) from error
        try:
            if states.keys() != self._names:
                self._meet(states, now_ns)
        except AttributeError:
            raise FederateError(
                f"physics, asked to advance to {seconds(now_ns)}, returned {states!r}, which is no mapping of states"
            ) from None
        self._at_ns = now_ns
        return states

    def _meet(self, states: Mapping[str, State], now_ns: int) -> None:
        """Note whom the physics moves, who may become more but not fewer."""
        if lost := self._names - states.keys():
            names = ", ".join(sorted(lost))
            raise FederateError(f"physics, asked to advance to {seconds(now_ns)}, has no state of {names}")
        self.new |= states.keys() - self._names
        self._names = frozenset(states)

    def with_new(self, begin: Mapping[str, State], states: Mapping[str, State]) -> Mapping[str, State]:
        """Return the states at a window's begin; with those at its end of agents that appeared in it, if any did."""
        if not self.new:
            return begin
        new, self.new = self.new, frozenset()
        return {**{name: states[name] for name in new}, **begin}

    def next_wake_ns(self) -> int | None:
        """Return when a program wakes next by itself, None for never."""
        return self._next_ns

    def next_send_ns(self) -> int | None:
        """Return before when surely no program sends anything by itself, None for never.

        Raises:
            FederateError: A program failed, or did not answer in time.
        """
        found: int | None = None
        for name, program in self.programs.items():
            try:
                at_ns = next_send_ns(program)
            except Exception as error:
                asked = f"say when it sends next after {seconds(self._at_ns)}"
                raise failed(error, f"the program of {name}", asked) from error
            if at_ns is not None and (found is None or at_ns < found):
                found = at_ns
        return found

    def _plan(self, names: Iterable[str]) -> None:
        """Ask programs when they wake next, which changes by nothing but waking; note when the first of all does."""
        for name in names:
            try:
                wake_ns = self.programs[name].next_wake_ns()
            except Exception as error:
                asked = f"say when it wakes next after {seconds(self._at_ns)}"
                raise failed(error, f"the program of {name}", asked) from error
            if wake_ns is None:
                self._wakes_ns.pop(name, None)
            elif wake_ns != self._wakes_ns.get(name):
                self._wakes_ns[name] = wake_ns
                heapq.heappush(self._planned, (wake_ns, name))
        # What programs have planned otherwise since stays in the heap until it comes up.
        planned = self._planned
        while planned and self._wakes_ns.get(planned[0][1]) != planned[0][0]:
            heapq.heappop(planned)
        self._next_ns = planned[0][0] if planned else None

    def hand_over(self, receiver: str, received: Received) -> None:
        """Let the program of an agent get a datagram when it is let go on next."""
        if receiver in self.programs:
            self._mail.setdefault(receiver, []).append(received)

    @property
    def mail(self) -> bool:
        """Whether a program has a datagram that it was not woken for."""
        return bool(self._mail)

    def advance(self, now_ns: int, last_ns: int, end_ns: int) -> tuple[list[Sent], Mapping[str, State]]:
        """Let programs act up to `last_ns`, those with mail first, now; then let bodies move on to `end_ns`.

        Returns:
            What programs sent, and the states at `end_ns`, as `states` gives them.

        Raises:
            FederateError: Physics or a program failed or did not answer in time, or wakes without end at one time.
        """
        sent: list[Sent] = []
        if self._mail:
            mail, self._mail = self._mail, {}
            sent += self._wake(now_ns, mail)
        woke_ns, turns = -1, 0
        while (wake_ns := self._next_ns) is not None and wake_ns <= last_ns:
            names = self._due(wake_ns)
            turns = turns + 1 if wake_ns <= woke_ns else 0
            if turns > _MOST_AT_ONCE:
                raise FederateError(
                    f"the program of {' and '.join(names)} woke {turns} times at {seconds(wake_ns)}, and goes on"
                )
            woke_ns = wake_ns
            sent += self._wake(wake_ns, dict.fromkeys(names, ()))
        return sent, self.states(end_ns)

    def _due(self, wake_ns: int) -> list[str]:
        """Take out of the plan, and return, who wakes at a time."""
        names = []
        while self._planned and self._planned[0][0] == wake_ns:
            _, name = heapq.heappop(self._planned)
            if self._wakes_ns.get(name) == wake_ns:
                del self._wakes_ns[name]
                names.append(name)
        return names

    def _wake(self, now_ns: int, mail: Mapping[str, Sequence[Received]]) -> list[Sent]:
        states = self.states(now_ns)
        sent: list[Sent] = []
        for name in sorted(mail):
            try:
                action = self.programs[name].wake(now_ns, states[name], mail[name])
            except Exception as error:
                raise failed(error, f"the program of {name}", f"act at {seconds(now_ns)}") from error
            sent += [Sent(now_ns, name, datagram, states) for datagram in action.datagrams]
            if action.command is not None:
                self._commands[name] = action.command
        self._plan(mail)
        return sent

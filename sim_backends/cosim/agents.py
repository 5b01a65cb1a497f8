"""The agents of a co-simulation: the bodies that the physics moves, and the programs that run on them."""

import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from sim_backends.cosim.federates import (
    FederateError,
    PhysicsFederate,
    Program,
    federate_error,
    next_send_ns,
    seconds_text,
)
from sim_backends.network.packets import Datagram, Received
from sim_backends.world.motion import State


class Sent(NamedTuple):
    """A datagram that a program sent.

    Attributes:
        at_ns: Time of sending.
        source: Name of the sending agent.
        datagram: The datagram.
        states: States of all agents at the last physics step before `at_ns`.
    """

    at_ns: int
    source: str
    datagram: Datagram
    states: Mapping[str, State]


_MAX_WAKES_AT_ONE_TIME: Final = 1000


class Agents:
    """Advances bodies and programs together. A program reads the state of its body at the current time in any window.

    Args:
        physics: Moves the bodies.
        programs: The program of each agent; an agent may have none.

    Raises:
        FederateError: A program failed.

    Attributes:
        physics: The physics.
        programs: The programs by agent name, sorted.
        new_agents: Agents that the physics has added since the last call of `with_new_agents`.
    """

    def __init__(self, physics: PhysicsFederate, programs: Mapping[str, Program]) -> None:
        self.physics = physics
        self.programs = dict(sorted(programs.items()))
        self.new_agents: frozenset[str] = frozenset()
        self._names = frozenset(programs)
        self._at_ns = 0
        self._received: dict[str, list[Received]] = {}
        self._commands: dict[str, Any] = {}
        self._wake_times_ns: dict[str, int] = {}
        self._queue: list[tuple[int, str]] = []
        self._next_ns: int | None = None
        self._schedule(self.programs)

    def states(self, now_ns: int) -> Mapping[str, State]:
        """Return the states of all agents at the last physics step that is not after `now_ns`.

        Raises:
            FederateError: The physics failed, did not answer in time, or has lost an agent.
        """
        commands = self._commands
        if commands:
            self._commands = {}
        try:
            states = self.physics.advance(now_ns, commands)
        except Exception as error:
            request = f"advance from {seconds_text(self._at_ns)} to {seconds_text(now_ns)}"
            raise federate_error(error, "physics", request) from error
        try:
            if states.keys() != self._names:
                self._update_names(states, now_ns)
        except AttributeError:
            raise FederateError(
                f"physics, requested to advance to {seconds_text(now_ns)}, returned {states!r}, which is not a "
                "mapping of states"
            ) from None
        self._at_ns = now_ns
        return states

    def _update_names(self, states: Mapping[str, State], now_ns: int) -> None:
        """Update the names of the agents; agents may appear during a run, but must not disappear."""
        if lost := self._names - states.keys():
            names = ", ".join(sorted(lost))
            raise FederateError(f"physics, requested to advance to {seconds_text(now_ns)}, has no state of {names}")
        self.new_agents |= states.keys() - self._names
        self._names = frozenset(states)

    def with_new_agents(self, begin: Mapping[str, State], end: Mapping[str, State]) -> Mapping[str, State]:
        """Return the states at the beginning of a window; agents that appeared in it have their state at its end."""
        if not self.new_agents:
            return begin
        new_agents, self.new_agents = self.new_agents, frozenset()
        return {**{name: end[name] for name in new_agents}, **begin}

    def next_wake_ns(self) -> int | None:
        """Return the next time at which a program's timer wakes it, or None if no timer is set."""
        return self._next_ns

    def next_send_ns(self) -> int | None:
        """Return a time before which no program sends because of a timer, or None if no timer causes sending.

        Raises:
            FederateError: A program failed, or did not answer in time.
        """
        earliest_ns: int | None = None
        for name, program in self.programs.items():
            try:
                at_ns = next_send_ns(program)
            except Exception as error:
                request = f"return its next send time after {seconds_text(self._at_ns)}"
                raise federate_error(error, f"the program of {name}", request) from error
            if at_ns is not None and (earliest_ns is None or at_ns < earliest_ns):
                earliest_ns = at_ns
        return earliest_ns

    def _schedule(self, names: Iterable[str]) -> None:
        """Read the next wake times of programs, which change only when a program wakes, and update the queue."""
        for name in names:
            try:
                wake_ns = self.programs[name].next_wake_ns()
            except Exception as error:
                request = f"return its next wake time after {seconds_text(self._at_ns)}"
                raise federate_error(error, f"the program of {name}", request) from error
            if wake_ns is None:
                self._wake_times_ns.pop(name, None)
            elif wake_ns != self._wake_times_ns.get(name):
                self._wake_times_ns[name] = wake_ns
                heapq.heappush(self._queue, (wake_ns, name))
        # Entries that a program has replaced stay in the heap until they are at its top.
        queue = self._queue
        while queue and self._wake_times_ns.get(queue[0][1]) != queue[0][0]:
            heapq.heappop(queue)
        self._next_ns = queue[0][0] if queue else None

    def deliver(self, receiver: str, received: Received) -> None:
        """Store a datagram for the program of an agent; the next call of `advance` delivers it."""
        if receiver in self.programs:
            self._received.setdefault(receiver, []).append(received)

    @property
    def has_undelivered(self) -> bool:
        """True if a stored datagram waits for the next call of `advance`."""
        return bool(self._received)

    def advance(self, now_ns: int, last_ns: int, end_ns: int) -> tuple[list[Sent], Mapping[str, State]]:
        """Wake programs that received datagrams or whose timer is due up to `last_ns`; move bodies to `end_ns`.

        Returns:
            The datagrams that programs sent, and the states at `end_ns` (see `states`).

        Raises:
            FederateError: Physics or a program failed or did not answer in time, or a program wakes endlessly at one
                time.
        """
        sent: list[Sent] = []
        if self._received:
            received, self._received = self._received, {}
            sent += self._wake(now_ns, received)
        woke_ns, repeats = -1, 0
        while (wake_ns := self._next_ns) is not None and wake_ns <= last_ns:
            names = self._pop_due(wake_ns)
            repeats = repeats + 1 if wake_ns <= woke_ns else 0
            if repeats > _MAX_WAKES_AT_ONE_TIME:
                raise FederateError(
                    f"the program of {' and '.join(names)} woke {repeats} times at {seconds_text(wake_ns)}: its "
                    "next wake time does not advance"
                )
            woke_ns = wake_ns
            sent += self._wake(wake_ns, dict.fromkeys(names, ()))
        return sent, self.states(end_ns)

    def _pop_due(self, wake_ns: int) -> list[str]:
        """Remove the agents whose programs wake at `wake_ns` from the queue, and return their names."""
        names = []
        while self._queue and self._queue[0][0] == wake_ns:
            _, name = heapq.heappop(self._queue)
            if self._wake_times_ns.get(name) == wake_ns:
                del self._wake_times_ns[name]
                names.append(name)
        return names

    def _wake(self, now_ns: int, received: Mapping[str, Sequence[Received]]) -> list[Sent]:
        states = self.states(now_ns)
        sent: list[Sent] = []
        for name in sorted(received):
            try:
                action = self.programs[name].wake(now_ns, states[name], received[name])
            except Exception as error:
                raise federate_error(error, f"the program of {name}", f"act at {seconds_text(now_ns)}") from error
            sent += [Sent(now_ns, name, datagram, states) for datagram in action.datagrams]
            if action.command is not None:
                self._commands[name] = action.command
        self._schedule(received)
        return sent

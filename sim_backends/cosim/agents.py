"""The agents of a co-simulation: bodies that the physics federate moves, and the programs that run on them."""

import heapq
from collections.abc import Iterable, Iterator, KeysView, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from typing_extensions import override

from sim_backends.cosim.federates import (
    FederateError,
    PhysicsFederate,
    Program,
    advance_text,
    federate_error,
    next_send_ns,
    seconds_text,
)
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.world.motion import Lifetime, State


class SentDatagram(NamedTuple):
    """A datagram that a program sent.

    Attributes:
        at_ns: Time of sending.
        source: Name of the sending agent.
        datagram: The datagram.
        states: States of the agents that are present, at the last physics step at or before `at_ns`.
    """

    at_ns: int
    source: str
    datagram: Datagram
    states: Mapping[str, State]


class AgentAbsence(NamedTuple):
    """The absence of an agent, before it appears or after it has disappeared.

    Attributes:
        since_ns: Beginning of the absence.
        state: The state that is used for the agent while it is absent. Before the agent first appears, this is its
            start state. After the agent has disappeared, this is its last position with a velocity of 0.
    """

    since_ns: int
    state: State


class _PresentStates(Mapping[str, State]):
    """The states of the agents that are present."""

    def __init__(self, states: Mapping[str, State], names: Mapping[str, None]) -> None:
        self._states = states
        self._names = names

    def __getitem__(self, name: str) -> State:
        if name not in self._names:
            raise KeyError(name)
        return self._states[name]

    @override
    def keys(self) -> KeysView[str]:
        return self._names.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


_MAX_WAKES_AT_ONE_TIME: Final = 1000
"""Largest number of repeated wakes, of any programs, at the same simulated time; with more, the run fails."""
_NO_LIFETIMES: Final[Mapping[str, Lifetime]] = MappingProxyType({})
_CHANGE: Final = ""
"""Name of the queue entry for the next beginning or end of a lifetime; it sorts before all names of agents."""


class Agents:
    """Advances bodies and programs together, so that programs always read the current state of their bodies.

    An agent is absent outside of its lifetime. If the attribute `agents_disappear` of the physics federate is True,
    an agent is also absent while the physics federate returns no state for it. The program of an absent agent does
    not wake.

    Args:
        physics: Moves the bodies.
        programs: Programs by agent name; agents without a program are omitted.
        lifetimes: The lifetimes of the agents that exist only during a part of the run.
        starts: The start states of agents that are absent at time 0; None if there are no such agents.

    Raises:
        FederateError: A program failed.

    Attributes:
        physics: The physics federate.
        programs: The programs by agent name, sorted.
        absent: The absence of each agent that is absent now, by name.
        has_changed: True if an agent has a lifetime, or if an agent has appeared or disappeared during the run.
    """

    def __init__(
        self,
        physics: PhysicsFederate,
        programs: Mapping[str, Program],
        lifetimes: Mapping[str, Lifetime] = _NO_LIFETIMES,
        starts: Mapping[str, State] | None = None,
    ) -> None:
        self.physics = physics
        self.programs = dict(sorted(programs.items()))
        self._lifetimes = dict(lifetimes)
        self.absent = {
            name: AgentAbsence(0, (starts or {})[name])
            for name, lifetime in self._lifetimes.items()
            if not lifetime.contains(0)
        }
        self.has_changed = bool(self._lifetimes)
        self._new_agents: frozenset[str] = frozenset()
        self._last_states: dict[str, State] = {}
        self._names = frozenset(programs) - self.absent.keys()
        self._states: Mapping[str, State] = {}
        self._names_outside_lifetime = frozenset(self.absent)
        # In descending order, so that the next change is the last item.
        self._changes_ns = sorted({at_ns for lifetime in lifetimes.values() for at_ns in lifetime.changes_ns})[::-1]
        self._states_ns = 0
        self._received: dict[str, list[ReceivedDatagram]] = {}
        self._commands: dict[str, Any] = {}
        self._wake_times_ns: dict[str, int] = {}
        self._queue: list[tuple[int, str]] = []
        self._next_ns: int | None = None
        self._schedule(name for name in self.programs if name not in self.absent)
        self._schedule_change()

    def states(self, now_ns: int) -> Mapping[str, State]:
        """Advance the bodies to `now_ns`, and return the states of the agents that are present then.

        These are the states at the last physics step at or before `now_ns`.

        Raises:
            FederateError: The physics federate failed, did not answer in time, or returned no state for an agent that
                must be present.
        """
        if self._changes_ns:
            self._read_states_at_changes(now_ns)
        commands = self._commands
        if commands:
            self._commands = {}
        try:
            states = self.physics.advance(now_ns, commands)
        except Exception as error:
            request = advance_text(self._states_ns, now_ns)
            raise federate_error(error, "physics", request) from error
        self._states_ns = now_ns
        try:
            if self._lifetimes:
                states = self._states_within_lifetime(states, now_ns)
            if states.keys() != self._names:
                self._update_names(states, now_ns)
        except AttributeError:
            raise FederateError(
                f"physics, requested to advance to {seconds_text(now_ns)}, returned {states!r}, which is not a "
                "mapping of states",
                remedy="return a mapping from the name of each agent to its State",
            ) from None
        self._states = states
        return states

    def _read_states_at_changes(self, now_ns: int) -> None:
        """Read the states just before and at each beginning or end of a lifetime.

        The last state of an agent then does not depend on the lengths of windows.
        """
        while (change_ns := self.next_change_ns()) is not None and change_ns <= now_ns:
            if self._states_ns < change_ns - 1:
                self.states(change_ns - 1)
            if change_ns == now_ns:
                return  # the caller reads the states at this time
            self.states(change_ns)

    def _states_within_lifetime(self, states: Mapping[str, State], now_ns: int) -> Mapping[str, State]:
        """Return the states of the agents that are within their lifetimes. The physics may also move other agents."""
        if self._changes_ns and self._changes_ns[-1] <= now_ns:
            while self._changes_ns and self._changes_ns[-1] <= now_ns:
                self._changes_ns.pop()
            self._schedule_change()
            self._names_outside_lifetime = frozenset(
                name for name, lifetime in self._lifetimes.items() if not lifetime.contains(now_ns)
            )
        if self._names_outside_lifetime.isdisjoint(states.keys()):
            return states
        return _PresentStates(
            states, dict.fromkeys(name for name in states if name not in self._names_outside_lifetime)
        )

    def _update_names(self, states: Mapping[str, State], now_ns: int) -> None:
        """Update the names of the agents that are present.

        Raises:
            FederateError: The physics federate returned no state for an agent within its lifetime, and it may not
                remove agents, or the agent is missing in its first states.
        """
        lost_names = self._names - states.keys()
        missing_names = lost_names - self._names_outside_lifetime
        if missing_names and not (self._states and getattr(self.physics, "agents_disappear", False)):
            names = ", ".join(sorted(missing_names))
            raise FederateError(
                f"physics, requested to advance to {seconds_text(now_ns)}, has no state of {names}",
                remedy="return the states of all agents, or set agents_disappear to True if physics removes agents",
            )
        for name in sorted(lost_names):
            state = self._states[name]
            lifetime = self._lifetimes.get(name)
            ended_ns = None if lifetime is None or lifetime.contains(now_ns) else lifetime.disappears_ns
            self.absent[name] = AgentAbsence(now_ns if ended_ns is None else ended_ns, State(state.position_m))
            self._last_states[name] = state
            self._received.pop(name, None)
            self._commands.pop(name, None)
            self._wake_times_ns.pop(name, None)
        new_names = states.keys() - self._names
        for name in new_names:
            self.absent.pop(name, None)
        # Before the first states, `_names` has only the agents with a program, so the other agents are not new.
        if self._states:
            self._new_agents |= new_names
            self.has_changed |= bool(lost_names or new_names)
        self._names = frozenset(states)
        self._schedule((name for name in sorted(new_names) if name in self.programs), now_ns)

    def with_changes(self, selected: Mapping[str, State], *, end: Mapping[str, State]) -> Mapping[str, State]:
        """Return the states that the network uses in a window, for all agents that were present in the window.

        An agent that appeared in the window has its state at the end of the window. An agent that disappeared has its
        last state. Each call includes only the changes since the previous call.

        Args:
            selected: The states that the sync policy selects for the window: those at its beginning or at its end.
            end: The states at the end of the window.
        """
        if not (self._new_agents or self._last_states):
            return selected
        new_agents, self._new_agents = self._new_agents, frozenset()
        last_states, self._last_states = self._last_states, {}
        added_states = {
            name: end.get(name) or last_states[name]
            for name in sorted(new_agents | last_states.keys())
            if name not in selected
        }
        return {**added_states, **selected} if added_states else selected

    def next_wake_ns(self) -> int | None:
        """Return the next time at which a timer wakes a program or a lifetime begins or ends, or None."""
        return self._next_ns

    def next_send_ns(self) -> int | None:
        """Return a lower bound of the next time at which a timer causes a program to send; None without such a time.

        Raises:
            FederateError: A program failed, or did not answer in time.
        """
        earliest_ns: int | None = None
        for name, program in self.programs.items():
            if name in self.absent:
                continue
            try:
                at_ns = next_send_ns(program)
            except Exception as error:
                request = f"return its next send time after {seconds_text(self._states_ns)}"
                raise federate_error(error, f"the program of {name}", request) from error
            if at_ns is not None and (earliest_ns is None or at_ns < earliest_ns):
                earliest_ns = at_ns
        return earliest_ns

    def _schedule(self, names: Iterable[str], earliest_ns: int | None = None) -> None:
        """Read the next wake times of programs, and update the queue; a program changes its time only when it wakes.

        Args:
            names: The agents of the programs.
            earliest_ns: Earliest wake time: the time at which the agents appeared. None if they were already present.
        """
        for name in names:
            try:
                wake_ns = self.programs[name].next_wake_ns()
            except Exception as error:
                request = f"return its next wake time after {seconds_text(self._states_ns)}"
                raise federate_error(error, f"the program of {name}", request) from error
            if wake_ns is None:
                self._wake_times_ns.pop(name, None)
                continue
            if earliest_ns is not None:
                wake_ns = max(wake_ns, earliest_ns)
            if wake_ns != self._wake_times_ns.get(name):
                self._wake_times_ns[name] = wake_ns
                heapq.heappush(self._queue, (wake_ns, name))
        self._update_next()

    def _schedule_change(self) -> None:
        """Add the next beginning or end of a lifetime to the queue, so that the states at that time are read."""
        if self._changes_ns:
            self._wake_times_ns[_CHANGE] = self._changes_ns[-1]
            heapq.heappush(self._queue, (self._changes_ns[-1], _CHANGE))
        self._update_next()

    def _update_next(self) -> None:
        # Entries that a program has replaced stay in the heap until they are at its top.
        queue = self._queue
        while queue and self._wake_times_ns.get(queue[0][1]) != queue[0][0]:
            heapq.heappop(queue)
        self._next_ns = queue[0][0] if queue else None

    def deliver(self, receiver: str, received_datagram: ReceivedDatagram) -> None:
        """Store a datagram for the program of an agent; the next call of `advance` delivers it.

        The datagram is dropped if the agent has no program or is absent.
        """
        if receiver in self.programs and receiver not in self.absent:
            self._received.setdefault(receiver, []).append(received_datagram)

    def is_absent(self, names: Iterable[str], at_ns: int) -> bool:
        """Return True if any of these agents is absent now and has been absent since `at_ns` or earlier."""
        absent = self.absent
        return any(name in absent and absent[name].since_ns <= at_ns for name in names)

    def next_change_ns(self) -> int | None:
        """Return the next time at which a lifetime begins or ends, or None."""
        return self._changes_ns[-1] if self._changes_ns else None

    @property
    def has_undelivered(self) -> bool:
        """True if there are stored datagrams that the next call of `advance` delivers."""
        return bool(self._received)

    def advance(self, now_ns: int, last_ns: int, end_ns: int) -> tuple[list[SentDatagram], Mapping[str, State]]:
        """Wake programs that received datagrams, and programs whose timers fire; then move the bodies.

        Args:
            now_ns: Beginning of the window; stored datagrams are delivered at this time.
            last_ns: Time up to which timers fire, inclusive.
            end_ns: Time to which the bodies move: the end of the window.

        Returns:
            The datagrams that programs sent, and the states at `end_ns` (see `states`).

        Raises:
            FederateError: Physics or a program failed or did not answer in time, or a program wakes endlessly at one
                time.
        """
        sent_datagrams: list[SentDatagram] = []
        if self._received:
            received_by_name, self._received = self._received, {}
            sent_datagrams += self._wake(now_ns, received_by_name)
        previous_wake_ns, repeats = -1, 0
        while (wake_ns := self._next_ns) is not None and wake_ns <= last_ns:
            names = self._pop_due(wake_ns)
            repeats = repeats + 1 if wake_ns <= previous_wake_ns else 0
            if repeats > _MAX_WAKES_AT_ONE_TIME:
                raise FederateError(
                    f"a program woke again {repeats} times at {seconds_text(wake_ns)}, most recently the program of "
                    f"{' and '.join(names)}: its next wake time does not advance",
                    remedy="correct the program: after a wake, next_wake_ns must return a later time",
                )
            previous_wake_ns = wake_ns
            sent_datagrams += self._wake(wake_ns, dict.fromkeys(names, ()))
        return sent_datagrams, self.states(end_ns)

    def _pop_due(self, wake_ns: int) -> list[str]:
        """Remove the agents whose programs wake at `wake_ns` from the queue, and return their names."""
        names = []
        while self._queue and self._queue[0][0] == wake_ns:
            _, name = heapq.heappop(self._queue)
            if self._wake_times_ns.get(name) == wake_ns:
                del self._wake_times_ns[name]
                names.append(name)
        return names

    def _wake(self, now_ns: int, received_by_name: Mapping[str, Sequence[ReceivedDatagram]]) -> list[SentDatagram]:
        """Wake the programs of these agents, and return the datagrams that they send."""
        states = self.states(now_ns)
        # `_CHANGE` is not an agent: its queue entry only causes the states at this time to be read.
        if self.absent or _CHANGE in received_by_name:
            received_by_name = {
                name: received_by_name[name] for name in received_by_name if name in states and name in self.programs
            }
        sent_datagrams: list[SentDatagram] = []
        for name in sorted(received_by_name):
            try:
                action = self.programs[name].wake(now_ns, states[name], received_by_name[name])
            except Exception as error:
                raise federate_error(error, f"the program of {name}", f"act at {seconds_text(now_ns)}") from error
            sent_datagrams += [SentDatagram(now_ns, name, datagram, states) for datagram in action.datagrams]
            if action.command is not None:
                self._commands[name] = action.command
        self._schedule(received_by_name)
        return sent_datagrams

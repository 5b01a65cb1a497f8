"""Proxies of physics and network federates that run in other processes."""

import copy
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from fieldkit.core.model import LinkSample
from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.exchanges import (
    AdvanceNetwork,
    NetworkOutcomes,
    decode_states,
    encode_advance_physics,
    encode_fork,
)
from sim_backends.federates.frames import NETWORK, PHYSICS, MessageKind
from sim_backends.federates.handshake import NO_EVENT, FederateCapability, Hello, Welcome
from sim_backends.federates.link_records import decode_links
from sim_backends.federates.protocols import FederateError, advance_text, seconds_text
from sim_backends.federates.records import ArrivalDelay, command_type
from sim_backends.federates.session import FederateSession, open_session
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State

ArrivalDelayLog = Callable[[Arrival, ArrivalDelay], None]
"""Called with each arrival, and the parts of its delay."""


class _RemoteFederate:
    """Base class of the proxies of physics and network federates.

    Attributes:
        session: The session.
        welcome: The federate's answer to the handshake.
    """

    def __init__(self, session: FederateSession, hello: Hello, welcome: Welcome) -> None:
        self.session = session
        self.welcome = welcome
        self._agents = AgentTable(agent.name for agent in hello.agents)
        self._copy = 0

    def close(self) -> None:
        """Stop the federate."""
        self.session.close()

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:  # noqa: ANN401 (an object of the subclass)
        """Copy the federate in its process, in its current state, and return the proxy of the copy.

        Raises:
            FederateError: The federate does not support copies, or failed.
        """
        if not self.welcome.capabilities & FederateCapability.FORK:
            raise FederateError(
                f"{self.session.name} cannot be copied, because it does not support fork",
                remedy="use another command, or a federate that supports it",
            )
        number = self.session.next_copy()
        self.session.request(
            MessageKind.FORK,
            self._copy,
            encode_fork(number),
            MessageKind.DONE,
            decode=bytes,
            describe=lambda: f"copy itself as copy {number}",
        )
        duplicate = object.__new__(type(self))
        memo[id(self)] = duplicate
        duplicate.__dict__.update(copy.deepcopy({**self.__dict__, "_copy": number}, memo))
        # The copy is released when its proxy is deleted. At the exit of the process the session ends anyway.
        weakref.finalize(duplicate, self.session.release, number).atexit = False
        return duplicate


class RemotePhysics(_RemoteFederate):
    """A physics federate in another process.

    A request that changes nothing is not sent: the states between two steps are the states at the first of them.

    Args:
        session: The session.
        hello: The hello that the federate received.
        welcome: Its answer.

    Attributes:
        step_ns: Time step, as reported in the federate's answer.
        limits_m_s2: Acceleration limit of each agent, as last reported by the federate; at first the limit in hello.
        agents_disappear: True if agents may disappear during a run.
    """

    def __init__(self, session: FederateSession, hello: Hello, welcome: Welcome) -> None:
        super().__init__(session, hello, welcome)
        self.step_ns = welcome.step_ns
        self.agents_disappear = bool(welcome.capabilities & FederateCapability.AGENTS_DISAPPEAR)
        self._limits_m_s2 = {agent.name: agent.limit_m_s2 for agent in hello.agents}
        self.limits_m_s2: Mapping[str, float] = self._limits_m_s2
        self._states: Mapping[str, State] = {}
        self._states_ns: int | None = None
        self._last_ns = 0

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Implement `PhysicsFederate.advance`."""
        at_ns = to_ns - to_ns % self.step_ns
        from_ns, self._last_ns = self._last_ns, to_ns
        if at_ns == self._states_ns and not commands:
            return self._states
        for name, command in commands.items():
            if command_type(command) not in self.welcome.commands:
                raise FederateError(
                    f"{self.session.name} does not support the command {type(command).__name__} to {name}"
                )
        states_ns, states = self.session.request(
            MessageKind.ADVANCE_PHYSICS,
            self._copy,
            encode_advance_physics(to_ns, from_ns, commands, self._agents),
            MessageKind.STATES,
            decode=partial(decode_states, agents=self._agents),
            describe=lambda: advance_text(from_ns, to_ns),
        )
        if states_ns != at_ns:
            self.session.fail(
                f"{self.session.name}, requested to advance to {seconds_text(to_ns)}, returned the states at "
                f"{seconds_text(states_ns)} instead of {seconds_text(at_ns)}, the time of its last step"
            )
        if not states.has_limits_of(self._states):
            self._limits_m_s2.update(states.limits_m_s2)
        self._states, self._states_ns = states, at_ns
        self.session.reached_ns = to_ns
        return states


class RemoteNetwork(_RemoteFederate):
    """A network federate in another process.

    If the network does not support absent agents, it receives the last position of an absent agent, or its start
    position if the agent has not appeared yet.

    Args:
        session: The session.
        hello: The hello that the federate received.
        welcome: Its answer.

    Attributes:
        extrapolates: True if the network evaluates dead-reckoned states at the time of each event.
        transmitters: Names of the agents that forward packets or interfere.
        fixed_emitters_m: Positions of interfering objects that are not agents.
    """

    def __init__(self, session: FederateSession, hello: Hello, welcome: Welcome) -> None:
        super().__init__(session, hello, welcome)
        self.extrapolates = bool(welcome.capabilities & FederateCapability.EXTRAPOLATES)
        if any(index >= len(hello.agents) for index in welcome.transmitters):
            session.fail(f"{session.name} listed a transmitter that is not an agent")
        self.transmitters = frozenset(hello.agents[index].name for index in welcome.transmitters)
        self.fixed_emitters_m = tuple(welcome.emitters_m)
        self._next_event_ns = welcome.next_event_ns
        self._last_ns = 0
        self._last_states: Mapping[str, State] | None = None
        if not welcome.capabilities & FederateCapability.AGENTS_DISAPPEAR:
            self._last_states = {agent.name: agent.start for agent in hello.agents}
        self._log_delay: ArrivalDelayLog | None = None

    def log_arrival_delays(self, log: ArrivalDelayLog | None) -> None:
        """Pass the parts of the delays of later arrivals to `log`, if the network reports them; None stops this."""
        self._log_delay = log

    def sample_links(self) -> dict[str, LinkSample]:
        """Return a sample of the links of each radio, at the network's current time.

        The result is empty if there are no radios, or if the network does not declare `SAMPLES_LINKS`.

        Raises:
            FederateError: The network failed, or sent a malformed answer.
        """
        if not self.welcome.capabilities & FederateCapability.SAMPLES_LINKS:
            return {}
        return self.session.request(
            MessageKind.SAMPLE_LINKS,
            self._copy,
            b"",
            MessageKind.LINKS,
            decode=partial(decode_links, agents=self._agents, utc_ns=time.time_ns()),
            describe=lambda: "sample the links",
        )

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Implement `NetworkFederate.advance`."""
        transports = self.welcome.transports
        for packet in packets if transports else ():
            if packet.protocol not in transports:
                raise FederateError(
                    f"{self.session.name} does not support the transport {packet.protocol}",
                    remedy=f"use one of {', '.join(transports)}, or list it in welcome",
                )
        since_ns, reckoning_ns = self._last_ns, 0
        if isinstance(states, DeadReckoned):
            since_ns, reckoning_ns = states.since_ns, states.step_ns
        if self._last_states is not None:
            # Absent agents are sent at rest, so that they are not extrapolated.
            absent_names = [name for name in self._last_states if name not in states]
            if absent_names:
                states = {**states, **{name: State(self._last_states[name].position_m) for name in absent_names}}
            self._last_states = states
        from_ns, self._last_ns = self._last_ns, to_ns
        outcomes = self.session.request(
            MessageKind.ADVANCE_NETWORK,
            self._copy,
            AdvanceNetwork(to_ns, states, packets, since_ns, reckoning_ns).encode(self._agents),
            MessageKind.OUTCOMES,
            decode=partial(NetworkOutcomes.decode, agents=self._agents),
            describe=lambda: advance_text(from_ns, to_ns),
        )
        if outcomes.at_ns != to_ns:
            self.session.fail(
                f"{self.session.name}, requested to advance to {seconds_text(to_ns)}, advanced to "
                f"{seconds_text(outcomes.at_ns)}"
            )
        self._next_event_ns = outcomes.next_event_ns
        self.session.reached_ns = to_ns
        if self._log_delay is not None and outcomes.delays:
            for arrival, parts in zip(outcomes.arrivals, outcomes.delays, strict=True):
                self._log_delay(arrival, parts)
        return list(outcomes.arrivals), list(outcomes.drops)

    def next_event_ns(self) -> int | None:
        """Implement `NetworkFederate.next_event_ns`."""
        if not self.welcome.capabilities & FederateCapability.NEXT_EVENT:
            raise FederateError(
                f"{self.session.name} does not report the time of its next event, which this sync policy needs",
                remedy="use another policy, for example sliding_window",
            )
        return None if self._next_event_ns == NO_EVENT else self._next_event_ns


def open_physics(endpoint: str, hello: Hello, deadline_s: float | None) -> RemotePhysics:
    """Start or connect to a physics federate.

    The arguments and the errors are those of `open_session`.
    """
    return RemotePhysics(*open_session(PHYSICS, endpoint, hello, deadline_s))


def open_network(endpoint: str, hello: Hello, deadline_s: float | None) -> RemoteNetwork:
    """Start or connect to a network federate.

    The arguments and the errors are those of `open_session`.
    """
    return RemoteNetwork(*open_session(NETWORK, endpoint, hello, deadline_s))

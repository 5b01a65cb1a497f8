"""The coordinator: advances agents and network window by window, and exchanges data between them.

It stores the payloads, and passes packets without payloads to the network. It records the fate of every packet.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from itertools import islice, repeat
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents, SentDatagram
from sim_backends.cosim.federates import (
    NetworkFederate,
    advance_text,
    check_physics,
    check_states,
    federate_error,
    seconds_text,
)
from sim_backends.cosim.packet_ledger import ABSENT, PacketLedger, fixed_emitters_m, transmitters
from sim_backends.cosim.policies.sync_policy import (
    LookingAhead,
    Pair,
    Situation,
    SyncPolicy,
    looks_ahead,
    missing_members,
)
from sim_backends.cosim.policies.window_ends import WindowEnds
from sim_backends.cosim.run_record import EventDigest, Fate, Run, Window, WindowObserver
from sim_backends.cosim.wall_time import Progress, WallTime, rate_limited
from sim_backends.network.packets import Arrival, Drop, Packet, ReceivedDatagram
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State

_NOTHING: Final[tuple[Sequence[Fate], Sequence[Packet], Sequence[Fate], Sequence[Fate]]] = (), (), (), ()
"""Values for a window without packets: the three results of `Coordinator._enter`, and the decided fates."""


class Coordinator:
    """Runs a co-simulation, starting at time 0.

    Args:
        agents: Bodies and programs.
        network: Carries packets.
        policy: Determines the length of windows.
        pairs: Sender and receiver of each possible transmission.
        observer: Called for every window, or None.
        measures_all: True to include all agents of `pairs` in the position error of every packet, as comparisons
            need; otherwise it includes the sender, the receiver, and the agents that forward or interfere in the
            network.

    Attributes:
        policy: The policy; it may be replaced after a window has ended.
        situation: The input of the policy for the next window.
        run: The record so far.
        is_committing: True while a window is being hashed and passed to the observer. An interrupt is delayed until
            both are done; otherwise the recording and the event hash would differ by that window
            (`interrupt_between_windows`).
        is_interrupted: True if `KeyboardInterrupt` must be raised as soon as `is_committing` is False.

    Raises:
        ConfigurationError: The physics federate or the policy lacks a required member, or the physics federate
            returns an invalid state or no state of an agent that may send, receive or interfere.
        FederateError: The physics federate failed, or has no state of an agent that runs a program.
    """

    def __init__(
        self,
        agents: Agents,
        network: NetworkFederate,
        policy: SyncPolicy,
        pairs: Sequence[Pair],
        *,
        observer: WindowObserver | None = None,
        measures_all: bool = False,
    ) -> None:
        check_physics(agents.physics)
        if missing_names := missing_members(policy):
            raise ConfigurationError(
                f"the sync policy {type(policy).__name__} lacks {', '.join(missing_names)}",
                remedy="see what a sync policy needs: fieldkit docs cosim-api",
            )
        self._agents = agents
        self._network = network
        self.policy = policy
        self._observer = observer
        self.run = Run()
        self.is_committing = self.is_interrupted = False
        other_agents, emitters_m = transmitters(network), fixed_emitters_m(network)
        paired_agents = {name for pair in pairs for name in pair}
        # With only two agents, every packet is between these two, and the ledger always includes its two ends.
        measured_agents = {*other_agents, *(paired_agents if measures_all and len(paired_agents) > 2 else ())}
        self._ledger = PacketLedger(
            self.run.fates, agents.physics.step_ns, measured_agents, has_fixed_emitters=bool(emitters_m)
        )
        # Agents whose positions affect packets: they send, receive, forward or interfere.
        self._active = paired_agents | {*other_agents}
        self._pairs, self._other_agents = tuple(pairs), other_agents
        self._deferred: Sequence[SentDatagram] = ()
        self._window_ends = WindowEnds()
        self._digest = EventDigest()
        self._extrapolates = getattr(network, "extrapolates", False)
        self._wall_time = WallTime(
            self.run.wall_s, agents=(agents.physics, *agents.programs.values()), network=(network,)
        )
        physics = agents.physics
        self.situation = Situation(
            0,
            agents.states(0),
            tuple(pairs),
            self._next_wake_ns,
            self._next_event_ns,
            physics.step_ns,
            physics.limits_m_s2,
            other_agents=other_agents,
            fixed_emitters_m=emitters_m,
        )
        check_states(self.situation.states)
        unmoved_agents = self._active - self.situation.states.keys() - agents.absent.keys()
        if unmoved_agents:
            raise ConfigurationError(
                f"the physics federate has no state of {', '.join(sorted(unmoved_agents))}, but agents that send, "
                "receive or interfere need one",
                remedy="return the states of all agents from advance",
            )
        self._select_present()
        if observer is not None:
            observer.begin(self.situation.states)

    def advance(self, to_ns: int, progress: Progress | None = None, *, max_windows: int | None = None) -> Run:
        """Simulate until `to_ns`, and return the record so far.

        Args:
            to_ns: End time.
            progress: Called at most every 0.2 s of wall time, or None.
            max_windows: Number of windows after which to stop in any case, or None for no limit.

        Raises:
            PolicyError: The policy cannot determine a window, or time does not advance; `run` has the record so far.
            FederateError: Physics, network or a program failed, did not answer in time, or returned an impossible
                answer.
        """
        try:
            self._run_windows(to_ns, max_windows, None if progress is None else rate_limited(progress))
        finally:
            self._wall_time.end_window()
            self.run.digest = self._digest.hexdigest()
        return self.run

    def fork(self) -> "Coordinator":
        """Return an independent copy of this co-simulation in its current state, without an observer."""
        # The second argument replaces the observer by None in the copy.
        return copy.deepcopy(self, {id(self._observer): None})

    def _next_wake_ns(self) -> int | None:
        if self._agents.has_undelivered or self._deferred:
            return self.situation.now_ns
        return self._agents.next_wake_ns()

    def _next_event_ns(self) -> int | None:
        try:
            return self._network.next_event_ns()
        except Exception as error:
            request = f"return the time of its next event after {seconds_text(self.situation.now_ns)}"
            raise federate_error(error, "network", request) from error

    def _run_windows(self, to_ns: int, max_windows: int | None, report: Callable[[int], None] | None) -> None:
        """Advance window by window.

        This loop is the overhead of the coordinator. To keep it fast, it uses local names, and does nothing for a
        window without packets that can be done later for many windows together. Unless the run is observed, the wall
        time after the answer of the network is counted in the first lap of the next window.
        """
        policy, agents, network, situation = self.policy, self._agents, self._network, self.situation
        windows_ns, quiet_ends_ns = self.run.windows_ns, self._digest.quiet_ends_ns
        looking_ahead = policy if looks_ahead(policy) else None
        uses_end_states, lap = policy.uses_end_states, self._wall_time.lap
        is_observed = self._observer is not None or report is not None
        self._wall_time.start()
        for _ in islice(repeat(None), max_windows):
            begin_ns = situation.now_ns
            if begin_ns >= to_ns:
                break
            if looking_ahead is not None:
                end_ns, sent_datagrams, states, assumed_states = self._look_ahead(looking_ahead, begin_ns, to_ns)
                last_ns = end_ns - 1
            else:
                end_ns = self._window_ends.next_ns(self.policy, situation, begin_ns, to_ns)
                lap("exchange")
                # If the network uses the states at the end of the window, events at that time belong to the window.
                last_ns = end_ns if uses_end_states else end_ns - 1
                sent_datagrams, states = agents.advance(begin_ns, last_ns, end_ns)
                lap("agents")
                assumed_states = agents.with_changes(states if uses_end_states else situation.states, end=states)
            entered_fates, packets, dropped_fates, decided_fates = _NOTHING
            if sent_datagrams or self._deferred:
                entered_fates, packets, dropped_fates = self._enter(sent_datagrams, begin_ns, assumed_states)
                lap("exchange")
            try:
                arrivals, drops = network.advance(last_ns, packets, assumed_states)
            except Exception as error:
                request = advance_text(begin_ns, last_ns)
                raise federate_error(error, "network", request) from error
            lap("network")
            self.is_committing = is_observed
            if entered_fates or arrivals or drops or agents.absent:
                decided_fates = [*dropped_fates, *self._record_outcomes(arrivals, drops, begin_ns, last_ns, end_ns)]
                self._digest.add_window(end_ns, entered_fates, decided_fates)
            else:
                quiet_ends_ns.append(end_ns)
            windows_ns.append(end_ns)
            situation.now_ns, situation.states = end_ns, states
            self._select_present()
            if is_observed:
                lap("exchange")
                self._notify(begin_ns, entered_fates, decided_fates, assumed_states, report=report)
                self._wall_time.start()

    def _look_ahead(
        self, policy: LookingAhead, begin_ns: int, to_ns: int
    ) -> tuple[int, list[SentDatagram], Mapping[str, State], Mapping[str, State]]:
        """Advance the agents ahead of the network within a window, as far as the policy allows.

        Returns:
            End of the window; datagrams that programs sent in it; states of the agents at its end; states that the
            network assumes.
        """
        agents, situation = self._agents, self.situation
        begin_states = situation.states
        # The window ends when an agent appears or disappears, because the set of states for the network then changes.
        to_ns = min(to_ns, agents.next_change_ns() or to_ns)
        # A network that does not extrapolate velocities (dead reckoning) assumes that agents do not move.
        moving_states = begin_states
        if not self._extrapolates:
            moving_states = {name: State(state.position_m) for name, state in begin_states.items()}
        step_ns = situation.physics_step_ns
        # The states are from the last physics step, which may be before the beginning of the window.
        since_ns = begin_ns // step_ns * step_ns
        self._update_situation(begin_ns, begin_states, moving_states, sent_datagrams=())
        reckoning_step_ns = policy.reckoning_step_ns(situation)
        assumed_states = DeadReckoned(moving_states, since_ns, reckoning_step_ns)
        end_ns = self._window_ends.next_ns(self.policy, situation, begin_ns, to_ns)
        lap = self._wall_time.lap
        lap("exchange")
        sent_datagrams, states = agents.advance(begin_ns, end_ns - 1, end_ns)
        lap("agents")
        while end_ns < to_ns:
            self._update_situation(end_ns, states, assumed_states.at(end_ns), sent_datagrams)
            try:
                later_ns = min(policy.extended_end_ns(situation), to_ns)
            except Exception as error:
                request = f"extend the window beyond {seconds_text(end_ns)}"
                raise federate_error(error, f"policy {policy.name}", request) from error
            if later_ns <= end_ns:
                break
            lap("exchange")
            later_datagrams, states = agents.advance(end_ns, later_ns - 1, later_ns)
            lap("agents")
            sent_datagrams += later_datagrams
            end_ns = later_ns
        if agents.has_changed:
            states_with_changes = agents.with_changes(begin_states, end=states)
            if states_with_changes is not begin_states:
                begin_states = states_with_changes
                stationary_states = {name: State(state.position_m) for name, state in begin_states.items()}
                assumed_states = DeadReckoned({**stationary_states, **moving_states}, since_ns, reckoning_step_ns)
        return end_ns, sent_datagrams, states, assumed_states if self._extrapolates else begin_states

    def _update_situation(
        self,
        now_ns: int,
        states: Mapping[str, State],
        assumed_states: Mapping[str, State],
        sent_datagrams: Sequence[SentDatagram],
    ) -> None:
        """Set the situation to a time within a window that the agents have reached before the network."""
        situation = self.situation
        situation.now_ns, situation.states, situation.assumed_states = now_ns, states, assumed_states
        self._select_present()
        is_pending = sent_datagrams or self._deferred or self._agents.has_undelivered
        situation.next_send_ns = now_ns if is_pending else self._agents.next_send_ns()

    def _enter(
        self, sent_datagrams: Sequence[SentDatagram], begin_ns: int, assumed_states: Mapping[str, State]
    ) -> tuple[Sequence[Fate], Sequence[Packet], Sequence[Fate]]:
        """Record the packets that enter the network in a window.

        They were sent in the window or, if the policy defers sends, in the previous window.

        Returns:
            The fates of these packets; the packets that the network must carry; the fates of the dropped packets.
        """
        if self.policy.defers_sends:
            sent_datagrams, self._deferred = self._deferred, sent_datagrams
        elif self._deferred:
            sent_datagrams, self._deferred = [*self._deferred, *sent_datagrams], ()
        absences = self._agents.absent if self._agents.has_changed else None
        entered_fates = [
            self._ledger.enter(datagram, max(datagram.at_ns, begin_ns), assumed_states, absences)
            for datagram in sent_datagrams
        ]
        for fate in entered_fates:
            source, destination = fate.packet.source, fate.packet.destination
            if source not in self._active or destination not in self._active:
                self._add_active(source, destination)
        carried_packets = [fate.packet for fate in entered_fates if not fate.reason]
        return (
            entered_fates,
            carried_packets,
            [] if len(carried_packets) == len(entered_fates) else [fate for fate in entered_fates if fate.reason],
        )

    def _add_active(self, *names: str) -> None:
        """Add agents that send or receive but are not in `pairs`, so that policies that look ahead include them."""
        self._active.update(names)
        self.situation.other_agents = self._other_agents = tuple(sorted({*self._other_agents, *names}))
        self._select_present()

    def _select_present(self) -> None:
        """Limit the pairs and the other agents of the situation to agents that are present."""
        if not self._agents.has_changed:
            return
        situation = self.situation
        present_names = set(situation.states)
        if situation.assumed_states is not None:
            present_names &= situation.assumed_states.keys()
        situation.pairs = tuple(pair for pair in self._pairs if present_names >= {*pair})
        situation.other_agents = tuple(name for name in self._other_agents if name in present_names)

    def _record_outcomes(
        self, arrivals: Sequence[Arrival], drops: Sequence[Drop], begin_ns: int, last_ns: int, end_ns: int
    ) -> list[Fate]:
        """Record the arrivals and drops of a window, and deliver the datagrams that arrived.

        An arrival is dropped if its sender or receiver had disappeared before it. Packets that are still under way
        from or to agents that are absent at the end of the window are dropped.
        """
        decided_fates, agents, ledger = [], self._agents, self._ledger
        for arrival in arrivals:
            if ledger.discard_withdrawn(arrival.packet_id):
                continue
            fate, payload = ledger.arrive(arrival, begin_ns, last_ns)
            packet = fate.packet
            if agents.absent and agents.is_absent((packet.source, packet.destination), arrival.at_ns):
                fate.arrived_ns, fate.reason = None, ABSENT
                decided_fates.append(fate)
                continue
            fate.counted_ns = end_ns if self.policy.defers_arrivals else arrival.at_ns
            fate.late_ns = end_ns - fate.counted_ns
            received_datagram = ReceivedDatagram(packet.source, payload, packet.sent_ns, fate.counted_ns)
            agents.deliver(packet.destination, received_datagram)
            decided_fates.append(fate)
        for drop in drops:
            if ledger.discard_withdrawn(drop.packet_id):
                continue
            fate = ledger.drop(drop)
            if agents.absent and agents.is_absent((fate.packet.source, fate.packet.destination), end_ns):
                fate.reason = ABSENT
            decided_fates.append(fate)
        if agents.absent:
            decided_fates += ledger.withdraw(agents.absent)
        return decided_fates

    def _notify(
        self,
        begin_ns: int,
        entered_fates: Sequence[Fate],
        decided_fates: Sequence[Fate],
        assumed_states: Mapping[str, State],
        *,
        report: Callable[[int], None] | None,
    ) -> None:
        """Pass the window that ends now to the observer, and report the progress."""
        end_ns, states = self.situation.now_ns, self.situation.states
        if self._observer is not None:
            decided_by = getattr(self.policy, "decided_by", "")
            wall_s = self._wall_time.end_window()
            self._observer.window(
                Window(begin_ns, end_ns, decided_by, entered_fates, decided_fates, states, assumed_states, wall_s)
            )
        if report is not None:
            report(end_ns)
        self.is_committing = False
        if self.is_interrupted:
            raise KeyboardInterrupt

"""The coordinator: lets agents and network go from window to window, and carries what crosses between them.

It keeps the payload; the network sees identities, sizes and times. It records what became of every packet.
"""

import copy
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents, Sent
from sim_backends.cosim.digest import EventDigest
from sim_backends.cosim.federates import NetworkFederate
from sim_backends.cosim.ledger import PacketLedger
from sim_backends.cosim.look_ahead import go_ahead, known_later
from sim_backends.cosim.observer import Window, WindowObserver
from sim_backends.cosim.policies.base import Pair, PolicyError, Situation, SyncPolicy
from sim_backends.cosim.run import Fate, Run
from sim_backends.cosim.wall_time import WallTime
from sim_backends.cosim.watchdog import DeadlinePassed, deadline, failed, seconds
from sim_backends.network.packets import Arrival, Drop, Packet, Received
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State

DEADLINE_S: Final = 30.0
_MOST_AT_ONCE: Final = 1000
_PROGRESS_EVERY_S: Final = 0.2

Progress = Callable[[int, float], None]
"""Called with simulated nanoseconds so far, and wall seconds since `advance` began."""


class Coordinator:
    """Runs a co-simulation from time 0 on.

    Args:
        agents: Bodies and programs.
        network: Carries packets.
        policy: Says how long windows are.
        pairs: Who may send to whom.
        observer: Is told of every window; None for nobody.
        deadline_s: Wall time in which physics, network, policy and each program have to answer; None for ever, as it
            has to be outside the main thread.

    Attributes:
        policy: As given; another one may go on where a window ended.
        run: What was recorded so far.

    Raises:
        ConfigurationError: Somebody may send or receive whom the physics does not move.
        FederateError: The physics failed, or does not move who runs a program.
    """

    def __init__(
        self,
        agents: Agents,
        network: NetworkFederate,
        policy: SyncPolicy,
        pairs: Sequence[Pair],
        *,
        observer: WindowObserver | None = None,
        deadline_s: float | None = DEADLINE_S,
    ) -> None:
        self._agents = agents
        self._network = network
        self.policy = policy
        self._pairs = tuple(pairs)
        self._observer = observer
        self._deadline_s = deadline_s
        self._asked_s = time.perf_counter()
        self.run = Run()
        self._ledger = PacketLedger(self.run.fates)
        self._held: list[tuple[Sent, Packet]] = []
        self._digest = EventDigest()
        self._extrapolates = getattr(network, "extrapolates", False)
        self._wall_time = WallTime(agents=(agents.physics, *agents.programs.values()), network=(network,))
        self._now_ns = 0
        self._states = agents.states(0)
        strangers = {name for pair in self._pairs for name in pair} - self._states.keys()
        if strangers:
            raise ConfigurationError(
                f"{', '.join(sorted(strangers))} may send or receive, but the physics moves none"
            )
        if observer is not None:
            observer.begin(self._states)

    def advance(self, to_ns: int, progress: Progress | None = None, *, most_windows: float = math.inf) -> Run:
        """Go on until `to_ns`; return what was recorded so far.

        Args:
            to_ns: Until when.
            progress: Is told how far it is, at most every 0.2 s of wall time; None for nobody.
            most_windows: After how many windows it stops in any case.

        Raises:
            PolicyError: The policy has no window, or one that does not end later; what was recorded is kept.
            FederateError: Physics, network or a program failed, did not answer in time, or answered what cannot be.
            ConfigurationError: There is a deadline, and this is not the main thread.
        """
        stood = windows = 0
        begun_s = told_s = self._asked_s = time.perf_counter()
        try:
            with deadline(self._deadline_s, self._last_asked_s):
                while self._now_ns < to_ns and windows < most_windows:
                    end_ns = self._next_window(to_ns)
                    stood = stood + 1 if end_ns <= self._now_ns else 0
                    if end_ns < self._now_ns or stood > _MOST_AT_ONCE:
                        raise PolicyError(
                            f"time does not go on beyond {self._now_ns} ns",
                            where=self.policy.name,
                            remedy="take another one",
                        )
                    self._window(end_ns, to_ns)
                    windows += 1
                    if progress is not None and self._asked_s - told_s >= _PROGRESS_EVERY_S:
                        told_s = self._asked_s
                        progress(self._now_ns, told_s - begun_s)
        except DeadlinePassed as error:
            raise failed(error, "the coordinator", f"go on from {seconds(self._now_ns)}") from error
        finally:
            self.run.digest = self._digest.hexdigest()
        return self.run

    def _last_asked_s(self) -> float:
        return max(self._asked_s, self._agents.asked_s)

    def _next_window(self, to_ns: int) -> int:
        self._asked_s = time.perf_counter()
        situation = self.situation
        try:
            end_ns = self.policy.next_window(situation)
        except PolicyError:
            raise
        except (Exception, DeadlinePassed) as error:
            asked = f"say when the window ends that begins at {seconds(self._now_ns)}"
            raise failed(error, f"policy {self.policy.name}", asked) from error
        return to_ns if end_ns is None else min(end_ns, to_ns)

    def fork(self) -> "Coordinator":
        """Return a co-simulation of its own that stands where this one does; neither changes the other.

        Nobody observes it.
        """
        return copy.deepcopy(self, {id(self._observer): None})

    @property
    def situation(self) -> Situation:
        """What the policy decides the next window by."""
        physics = self._agents.physics
        try:
            next_event_ns = self._network.next_event_ns()
        except (Exception, DeadlinePassed) as error:
            raise failed(error, "network", f"tell its next event after {seconds(self._now_ns)}") from error
        offered = self._agents.mail or bool(self._held)
        situation = Situation(
            self._now_ns,
            self._states,
            self._pairs,
            self._now_ns if offered else self._agents.next_wake_ns(),
            next_event_ns,
            physics.step_ns,
            physics.limits_m_s2,
        )
        if not hasattr(self.policy, "goes_on"):
            return situation
        return situation._replace(
            next_send_ns=self._now_ns if offered else self._agents.next_send_ns(),
            known=known_later(situation, moves=self._extrapolates),
        )

    def _window(self, end_ns: int, to_ns: int) -> None:
        policy = self.policy
        begun_s, decided_s = self._asked_s, time.perf_counter()
        known: Mapping[str, State]
        if hasattr(policy, "goes_on"):
            end_ns, sent, states, known, looked_s = self._look_ahead(policy.goes_on, end_ns, to_ns)
            last_ns = end_ns - 1
        else:
            # The end of a window belongs to it where the network knows the states at it.
            last_ns = end_ns if policy.knows_end else end_ns - 1
            sent = self._agents.advance(self._now_ns, last_ns)
            states, looked_s = self._agents.states(end_ns), 0.0
            known = states if policy.knows_end else self._states
        moved_s = time.perf_counter() - looked_s
        entered = self._enter(sent, end_ns, known) if sent or self._held else []
        offered_s = self._asked_s = time.perf_counter()
        arrivals, drops = self._carry(last_ns, [fate.packet for fate in entered], known)
        carried_s = time.perf_counter()
        ended = [self._arrive(arrival, last_ns, end_ns) for arrival in arrivals]
        ended += [self._ledger.drop(drop) for drop in drops]
        self._digest.window(end_ns, entered, ended)
        self.run.windows_ns.append(end_ns)
        begin_ns, self._now_ns, self._states = self._now_ns, end_ns, states
        agents_s, network_s = moved_s - decided_s, carried_s - offered_s
        wall_s = self._wall_time.split(agents_s, network_s, time.perf_counter() - begun_s - agents_s - network_s)
        total_s = self.run.wall_s
        total_s["agents"] += wall_s["agents"]
        total_s["network"] += wall_s["network"]
        total_s["exchange"] += wall_s["exchange"]
        total_s["wait"] += wall_s["wait"]
        if self._observer is not None:
            decided_by = getattr(policy, "decided_by", "")
            self._observe(Window(begin_ns, end_ns, decided_by, entered, ended, states, known, wall_s))

    def _look_ahead(
        self, goes_on: Callable[[Situation], int], end_ns: int, to_ns: int
    ) -> tuple[int, list[Sent], Mapping[str, State], Mapping[str, State], float]:
        """Let agents go on as far as the policy sees that they may; return that, and what the network is told."""
        situation = self.situation
        known = known_later(situation, moves=self._extrapolates)
        ahead = go_ahead(self._agents, goes_on, situation, known, end_ns=end_ns, most_ns=to_ns)
        told = known if self._extrapolates else self._states
        return ahead.end_ns, ahead.sent, ahead.states, told, ahead.looked_s

    def _enter(self, sent: Sequence[Sent], end_ns: int, known: Mapping[str, State]) -> list[Fate]:
        holds = self.policy.holds_sends
        offered = [(one, self._ledger.packet(one, end_ns if holds else one.at_ns)) for one in sent]
        entering, self._held = (self._held, offered) if holds else (self._held + offered, [])
        if isinstance(known, DeadReckoned):
            return [self._ledger.enter(one, packet, known.at(packet.enters_ns)) for one, packet in entering]
        return [self._ledger.enter(one, packet, known) for one, packet in entering]

    def _carry(
        self, last_ns: int, packets: Sequence[Packet], known: Mapping[str, State]
    ) -> tuple[Sequence[Arrival], Sequence[Drop]]:
        try:
            return self._network.advance(last_ns, packets, known)
        except (Exception, DeadlinePassed) as error:
            raise failed(error, "network", f"advance from {seconds(self._now_ns)} to {seconds(last_ns)}") from error

    def _arrive(self, arrival: Arrival, last_ns: int, end_ns: int) -> Fate:
        fate, payload = self._ledger.arrive(arrival, self._now_ns, last_ns)
        packet = fate.packet
        fate.counted_ns = end_ns if self.policy.holds_arrivals else arrival.at_ns
        fate.late_ns = end_ns - fate.counted_ns
        self._agents.hand_over(packet.destination, Received(packet.source, payload, packet.sent_ns, fate.counted_ns))
        return fate

    def _observe(self, window: Window) -> None:
        assert self._observer is not None
        self._asked_s = time.perf_counter()
        try:
            self._observer.window(window)
        except DeadlinePassed as error:
            raise failed(error, "recorder", f"keep the window that ended at {seconds(window.end_ns)}") from error

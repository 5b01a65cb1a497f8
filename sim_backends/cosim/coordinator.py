"""The coordinator: lets agents and network go from window to window, and carries what crosses between them.

It keeps the payload; the network sees identities, sizes and times. It records what became of every packet.
"""

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents, Sent
from sim_backends.cosim.digest import EventDigest
from sim_backends.cosim.federates import NetworkFederate
from sim_backends.cosim.ledger import PacketLedger
from sim_backends.cosim.observer import Window, WindowObserver
from sim_backends.cosim.policies.base import Pair, PolicyError, Situation, SyncPolicy
from sim_backends.cosim.run import Fate, Run
from sim_backends.cosim.wall_time import WallTime
from sim_backends.cosim.watchdog import DeadlinePassed, deadline, failed, seconds
from sim_backends.network.packets import Arrival, Drop, Packet, Received
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
        situation: What the policy decides the next window by.
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
        self._observer = observer
        self._deadline_s = deadline_s
        self._asked_s = time.perf_counter()
        self.run = Run()
        self._ledger = PacketLedger(self.run.fates)
        self._held: Sequence[Sent] = ()
        self._stood_ns = self._stood = 0
        self._digest = EventDigest()
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
        )
        strangers = {name for pair in pairs for name in pair} - self.situation.states.keys()
        if strangers:
            raise ConfigurationError(
                f"{', '.join(sorted(strangers))} may send or receive, but the physics moves none"
            )
        if observer is not None:
            observer.begin(self.situation.states)

    def advance(self, to_ns: int, progress: Progress | None = None) -> Run:
        """Go on until `to_ns`; return what was recorded so far.

        Args:
            to_ns: Until when.
            progress: Is told how far it is, at most every 0.2 s of wall time; None for nobody.

        Raises:
            PolicyError: The policy has no window, or one that does not end later; what was recorded is kept.
            FederateError: Physics, network or a program failed, did not answer in time, or answered what cannot be.
            ConfigurationError: There is a deadline, and this is not the main thread.
        """
        try:
            with deadline(self._deadline_s, self._last_asked_s):
                self._go(to_ns, None if progress is None else _teller(progress))
        except DeadlinePassed as error:
            raise failed(error, "the coordinator", f"go on from {seconds(self.situation.now_ns)}") from error
        finally:
            self.run.digest = self._digest.hexdigest()
        return self.run

    def _last_asked_s(self) -> float:
        return max(self._asked_s, self._agents.asked_s)

    def fork(self) -> "Coordinator":
        """Return a co-simulation of its own that stands where this one does; neither changes the other.

        Nobody observes it.
        """
        return copy.deepcopy(self, {id(self._observer): None})

    def _next_wake_ns(self) -> int | None:
        return self.situation.now_ns if self._agents.mail or self._held else self._agents.next_wake_ns()

    def _next_event_ns(self) -> int | None:
        try:
            return self._network.next_event_ns()
        except (Exception, DeadlinePassed) as error:
            asked = f"tell its next event after {seconds(self.situation.now_ns)}"
            raise failed(error, "network", asked) from error

    def _go(self, to_ns: int, tell: Callable[[int, float], None] | None) -> None:
        """Let everybody go on, window by window.

        Its own time is what coordination costs, so it is one function with local names, and does nothing in a window
        without packets that can be done for many at once. Who is asked next is asked since the one before answered:
        one look at the clock tells both how long an answer took and since when the next one is waited for.
        """
        policy, agents, network, situation = self.policy, self._agents, self._network, self.situation
        windows_ns, quiet_ns = self.run.windows_ns, self._digest.quiet_ns
        knows_end, clock = policy.knows_end, time.perf_counter
        agents_s = network_s = whole_s = 0.0
        self._asked_s = clock()
        try:
            while (begin_ns := situation.now_ns) < to_ns:
                begun_s = self._asked_s
                end_ns = self._next_window(begin_ns, to_ns)
                decided_s = self._asked_s = clock()
                # The end of a window belongs to it where the network knows the states at it.
                last_ns = end_ns if knows_end else end_ns - 1
                sent = agents.advance(begin_ns, last_ns)
                states = agents.states(end_ns)
                known = states if knows_end else situation.states
                moved_s = offered_s = self._asked_s = clock()
                entered: Sequence[Fate] = ()
                packets: Sequence[Packet] = ()
                if sent or self._held:
                    entered = self._enter(sent, begin_ns, known)
                    packets = [fate.packet for fate in entered]
                    offered_s = self._asked_s = clock()
                try:
                    arrivals, drops = network.advance(last_ns, packets, known)
                except (Exception, DeadlinePassed) as error:
                    asked = f"advance from {seconds(begin_ns)} to {seconds(last_ns)}"
                    raise failed(error, "network", asked) from error
                carried_s = clock()
                ended: Sequence[Fate] = ()
                if entered or arrivals or drops:
                    ended = self._end(arrivals, drops, begin_ns, last_ns, end_ns)
                    self._digest.window(end_ns, entered, ended)
                else:
                    quiet_ns.append(end_ns)
                windows_ns.append(end_ns)
                situation.now_ns, situation.states = end_ns, states
                ended_s = self._asked_s = clock()
                agents_s += moved_s - decided_s
                network_s += carried_s - offered_s
                whole_s += ended_s - begun_s
                if self._observer is not None:
                    wall_s = self._wall_time.split(moved_s - decided_s, carried_s - offered_s, ended_s - begun_s)
                    decided_by = getattr(policy, "decided_by", "")
                    self._observe(Window(begin_ns, end_ns, decided_by, entered, ended, states, known, wall_s))
                if tell is not None:
                    tell(end_ns, ended_s)
                    self._asked_s = clock()
        finally:
            self._wall_time.add(agents_s, network_s, whole_s)

    def _next_window(self, begin_ns: int, to_ns: int) -> int:
        try:
            end_ns = self.policy.next_window(self.situation)
        except PolicyError:
            raise
        except (Exception, DeadlinePassed) as error:
            asked = f"say when the window ends that begins at {seconds(begin_ns)}"
            raise failed(error, f"policy {self.policy.name}", asked) from error
        if end_ns is None or end_ns > to_ns:
            return to_ns
        if end_ns <= begin_ns:
            self._stand(begin_ns, end_ns)
        return end_ns

    def _stand(self, begin_ns: int, end_ns: int) -> None:
        """Take note of a window in which time does not go on; there may be some, but not without end."""
        if begin_ns != self._stood_ns:
            self._stood_ns, self._stood = begin_ns, 0
        self._stood += 1
        if end_ns < begin_ns or self._stood > _MOST_AT_ONCE:
            raise PolicyError(
                f"time does not go on beyond {begin_ns} ns", where=self.policy.name, remedy="take another one"
            )

    def _enter(self, sent: Sequence[Sent], begin_ns: int, known: Mapping[str, State]) -> list[Fate]:
        """Book what enters the network in a window: what was sent in it, or, by policy, in the one before."""
        entered = [self._ledger.enter(one, begin_ns, known) for one in self._held]
        self._held = []
        if self.policy.holds_sends:
            self._held = sent
            return entered
        return entered + [self._ledger.enter(one, one.at_ns, known) for one in sent]

    def _end(
        self, arrivals: Sequence[Arrival], drops: Sequence[Drop], begin_ns: int, last_ns: int, end_ns: int
    ) -> list[Fate]:
        """Book what became of packets in a window, and hand over what arrived."""
        ended = []
        for arrival in arrivals:
            fate, payload = self._ledger.arrive(arrival, begin_ns, last_ns)
            packet = fate.packet
            fate.counted_ns = end_ns if self.policy.holds_arrivals else arrival.at_ns
            fate.late_ns = end_ns - fate.counted_ns
            received = Received(packet.source, payload, packet.sent_ns, fate.counted_ns)
            self._agents.hand_over(packet.destination, received)
            ended.append(fate)
        ended += [self._ledger.drop(drop) for drop in drops]
        return ended

    def _observe(self, window: Window) -> None:
        assert self._observer is not None
        try:
            self._observer.window(window)
        except DeadlinePassed as error:
            raise failed(error, "recorder", f"keep the window that ended at {seconds(window.end_ns)}") from error
        self._asked_s = time.perf_counter()


def _teller(progress: Progress) -> Callable[[int, float], None]:
    """Return what tells how far a run is, and passes it on now and then."""
    began_s = told_s = time.perf_counter()

    def tell(now_ns: int, at_s: float) -> None:
        nonlocal told_s
        if at_s - told_s >= _PROGRESS_EVERY_S:
            told_s = at_s
            progress(now_ns, at_s - began_s)

    return tell

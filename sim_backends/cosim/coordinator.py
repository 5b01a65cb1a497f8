"""The coordinator: lets agents and network go from window to window, and carries what crosses between them.

It keeps the payload; the network sees identities, sizes and times. It records what became of every packet.
"""

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice, repeat
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents, Sent
from sim_backends.cosim.digest import EventDigest
from sim_backends.cosim.federates import NetworkFederate
from sim_backends.cosim.ledger import PacketLedger
from sim_backends.cosim.observer import Window, WindowObserver
from sim_backends.cosim.policies.base import LookingAhead, Pair, PolicyError, Situation, SyncPolicy
from sim_backends.cosim.run import Fate, Run
from sim_backends.cosim.wall_time import WallTime
from sim_backends.cosim.watchdog import DeadlinePassed, deadline, failed, seconds
from sim_backends.network.packets import Arrival, Drop, Packet, Received
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State

DEADLINE_S: Final = 30.0
_MOST_AT_ONCE: Final = 1000
_PROGRESS_EVERY_S: Final = 0.2
_NOTHING: Final[tuple[Sequence[Fate], Sequence[Packet], Sequence[Fate]]] = (), (), ()
"""What enters in a window without packets, as fates and packets, and what ends in it."""

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
        )
        strangers = {name for pair in pairs for name in pair} - self.situation.states.keys()
        if strangers:
            raise ConfigurationError(
                f"{', '.join(sorted(strangers))} may send or receive, but the physics moves none"
            )
        if observer is not None:
            observer.begin(self.situation.states)

    def advance(self, to_ns: int, progress: Progress | None = None, *, most_windows: int | None = None) -> Run:
        """Go on until `to_ns`; return what was recorded so far.

        Args:
            to_ns: Until when.
            progress: Is told how far it is, at most every 0.2 s of wall time; None for nobody.
            most_windows: After how many windows it stops in any case; None for as many as there are.

        Raises:
            PolicyError: The policy has no window, or one that does not end later; what was recorded is kept.
            FederateError: Physics, network or a program failed, did not answer in time, or answered what cannot be.
            ConfigurationError: There is a deadline, and this is not the main thread.
        """
        try:
            with deadline(self._deadline_s, self._last_asked_s):
                self._go(to_ns, most_windows, None if progress is None else _teller(progress))
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

    def _go(self, to_ns: int, most_windows: int | None, tell: Callable[[int], None] | None) -> None:
        """Let everybody go on, window by window.

        Its own time is what coordination costs, so it is one function with local names, and does nothing in a window
        without packets that can be done for many at once. Who is asked next is asked since the one before answered:
        one look at the clock tells both how long an answer took and since when the next one is waited for. What a
        window takes after the network's answer counts to the next one, unless somebody watches.
        """
        policy, agents, network, situation = self.policy, self._agents, self._network, self.situation
        windows_ns, quiet_ns = self.run.windows_ns, self._digest.quiet_ns
        looking = policy if isinstance(policy, LookingAhead) else None
        knows_end, clock = policy.knows_end, time.perf_counter
        watched = self._observer is not None or tell is not None
        agents_s = network_s = whole_s = 0.0
        self._asked_s = clock()
        try:
            for _ in islice(repeat(None), most_windows):
                begin_ns, begun_s = situation.now_ns, self._asked_s
                if begin_ns >= to_ns:
                    break
                if looking is not None:
                    end_ns, sent, states, known, decided_s = self._look_ahead(looking, begin_ns, to_ns)
                    last_ns = end_ns - 1
                else:
                    end_ns = self._next_window(begin_ns, to_ns)
                    decided_s = self._asked_s = clock()
                    # The end of a window belongs to it where the network knows the states at it.
                    last_ns = end_ns if knows_end else end_ns - 1
                    sent, states = agents.advance(begin_ns, last_ns, end_ns)
                    known = states if knows_end else situation.states
                moved_s = offered_s = self._asked_s = clock()
                entered, packets, ended = _NOTHING
                if sent or self._held:
                    entered, packets = self._enter(sent, begin_ns, known)
                    offered_s = self._asked_s = clock()
                try:
                    arrivals, drops = network.advance(last_ns, packets, known)
                except (Exception, DeadlinePassed) as error:
                    raise failed(
                        error, "network", f"advance from {seconds(begin_ns)} to {seconds(last_ns)}"
                    ) from error
                carried_s = ended_s = self._asked_s = clock()
                if entered or arrivals or drops:
                    ended = self._end(arrivals, drops, begin_ns, last_ns, end_ns)
                    self._digest.window(end_ns, entered, ended)
                else:
                    quiet_ns.append(end_ns)
                windows_ns.append(end_ns)
                situation.now_ns, situation.states = end_ns, states
                if watched:
                    ended_s = clock()
                    spent_s = moved_s - decided_s, carried_s - offered_s, ended_s - begun_s
                    self._watch(begin_ns, entered, ended, known, spent_s=spent_s, tell=tell)
                    self._asked_s = clock()
                agents_s += moved_s - decided_s
                network_s += carried_s - offered_s
                whole_s += ended_s - begun_s
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

    def _look_ahead(
        self, policy: LookingAhead, begin_ns: int, to_ns: int
    ) -> tuple[int, list[Sent], Mapping[str, State], Mapping[str, State], float]:
        """Let agents go ahead of the network in a window, as far as the policy sees that they may.

        Returns:
            When the window ends; what programs sent in it; where the agents are then; where the network takes them
            to be; and when the policy had decided, if it had at once: what it took later is added.
        """
        agents, situation = self._agents, self.situation
        begin = situation.states
        # A network that cannot let agents move on takes them to stand.
        moving = begin if self._extrapolates else {name: State(one.position_m) for name, one in begin.items()}
        known = DeadReckoned(moving, begin_ns, situation.physics_step_ns)
        self._see(begin_ns, begin, known, sent=())
        end_ns = self._next_window(begin_ns, to_ns)
        decided_s = self._asked_s = time.perf_counter()
        sent, states = agents.advance(begin_ns, end_ns - 1, end_ns)
        while end_ns < to_ns:
            moved_s = self._asked_s = time.perf_counter()
            self._see(end_ns, states, known.at(end_ns), sent)
            try:
                later_ns = min(policy.goes_on(situation), to_ns)
            except (Exception, DeadlinePassed) as error:
                asked = f"say until when the window goes on that has come to {seconds(end_ns)}"
                raise failed(error, f"policy {policy.name}", asked) from error
            self._asked_s = time.perf_counter()
            decided_s += self._asked_s - moved_s
            if later_ns <= end_ns:
                break
            more, states = agents.advance(end_ns, later_ns - 1, later_ns)
            sent += more
            end_ns = later_ns
        return end_ns, sent, states, known if self._extrapolates else begin, decided_s

    def _see(
        self, now_ns: int, states: Mapping[str, State], known: Mapping[str, State], sent: Sequence[Sent]
    ) -> None:
        """Bring the situation to a time in a window that agents have come to, ahead of the network."""
        situation = self.situation
        situation.now_ns, situation.states, situation.known = now_ns, states, known
        waits = sent or self._held or self._agents.mail
        situation.next_send_ns = now_ns if waits else self._agents.next_send_ns()

    def _stand(self, begin_ns: int, end_ns: int) -> None:
        """Take note of a window in which time does not go on; there may be some, but not without end."""
        if begin_ns != self._stood_ns:
            self._stood_ns, self._stood = begin_ns, 0
        self._stood += 1
        if end_ns < begin_ns or self._stood > _MOST_AT_ONCE:
            raise PolicyError(
                f"time does not go on beyond {begin_ns} ns", where=self.policy.name, remedy="take another one"
            )

    def _enter(
        self, sent: Sequence[Sent], begin_ns: int, known: Mapping[str, State]
    ) -> tuple[Sequence[Fate], Sequence[Packet]]:
        """Book what enters the network in a window: what was sent in it, or, by policy, in the one before."""
        if self.policy.holds_sends:
            sent, self._held = self._held, sent
        elif self._held:
            sent, self._held = [*self._held, *sent], ()
        entered = [self._ledger.enter(one, max(one.at_ns, begin_ns), known) for one in sent]
        return entered, [fate.packet for fate in entered]

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
        ended.extend(map(self._ledger.drop, drops))
        return ended

    def _watch(
        self,
        begin_ns: int,
        entered: Sequence[Fate],
        ended: Sequence[Fate],
        known: Mapping[str, State],
        *,
        spent_s: tuple[float, float, float],
        tell: Callable[[int], None] | None,
    ) -> None:
        """Let whoever watches know of the window that ends now."""
        end_ns, states = self.situation.now_ns, self.situation.states
        if self._observer is not None:
            decided_by = getattr(self.policy, "decided_by", "")
            wall_s = self._wall_time.split(*spent_s)
            try:
                self._observer.window(Window(begin_ns, end_ns, decided_by, entered, ended, states, known, wall_s))
            except DeadlinePassed as error:
                raise failed(error, "recorder", f"keep the window that ended at {seconds(end_ns)}") from error
        if tell is not None:
            tell(end_ns)


def _teller(progress: Progress) -> Callable[[int], None]:
    """Return what is told how far a run is, and passes it on now and then."""
    began_s = told_s = time.perf_counter()

    def tell(now_ns: int) -> None:
        nonlocal told_s
        at_s = time.perf_counter()
        if at_s - told_s >= _PROGRESS_EVERY_S:
            told_s = at_s
            progress(now_ns, at_s - began_s)

    return tell

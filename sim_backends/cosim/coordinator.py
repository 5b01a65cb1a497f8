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
from sim_backends.cosim.federate_errors import failed, seconds
from sim_backends.cosim.federates import NetworkFederate, check_physics, check_states
from sim_backends.cosim.geometry import fixed_emitters_m, transmitting
from sim_backends.cosim.ledger import PacketLedger
from sim_backends.cosim.observer import Window, WindowObserver
from sim_backends.cosim.policies.base import LookingAhead, Pair, PolicyError, Situation, SyncPolicy
from sim_backends.cosim.run import Fate, Run
from sim_backends.cosim.wall_time import WallTime
from sim_backends.network.packets import Arrival, Drop, Packet, Received
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State

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
        measures_all: Whether errors of places include all agents of `pairs` for every packet, as comparisons need;
            else those of its sender, its receiver, and what the network names as forwarding or interfering.

    Attributes:
        policy: As given; another one may go on where a window ended.
        situation: What the policy decides the next window by.
        run: What was recorded so far.
        commits: Whether a window is being hashed and handed to the observer. An interrupt must wait until both have
            it, or the recording and the event hash differ by that window (`interrupts`).
        is_interrupted: Whether to raise `KeyboardInterrupt` once that is over.

    Raises:
        ConfigurationError: Somebody may send or receive whom the physics does not move, or the physics has not all
            that one needs.
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
        measures_all: bool = False,
    ) -> None:
        check_physics(agents.physics)
        self._agents = agents
        self._network = network
        self.policy = policy
        self._observer = observer
        self.run = Run()
        self.commits = self.is_interrupted = False
        others, fixed_m = transmitting(network), fixed_emitters_m(network)
        in_pairs = {name for pair in pairs for name in pair}
        # Of two agents both are known by their packets.
        measured = {*others, *(in_pairs if measures_all and len(in_pairs) > 2 else ())}
        self._ledger = PacketLedger(self.run.fates, agents.physics.step_ns, measured, anchored=bool(fixed_m))
        self._active = in_pairs | {*others}
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
            others=others,
            fixed_m=fixed_m,
        )
        check_states(self.situation.states)
        strangers = self._active - self.situation.states.keys()
        if strangers:
            raise ConfigurationError(
                f"{', '.join(sorted(strangers))} may send or receive, or interfere, and the physics moves none"
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
            FederateError: Physics, network or a program failed, did not answer in time, or gave an impossible answer.
        """
        try:
            self._go(to_ns, most_windows, None if progress is None else _teller(progress))
        finally:
            self._wall_time.window()
            self.run.digest = self._digest.hexdigest()
        return self.run

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
        except Exception as error:
            asked = f"tell its next event after {seconds(self.situation.now_ns)}"
            raise failed(error, "network", asked) from error

    def _go(self, to_ns: int, most_windows: int | None, tell: Callable[[int], None] | None) -> None:
        """Advance window by window.

        Its own time is the cost of coordination. It therefore uses local names, and does nothing in a window without
        packets that can be done for many windows together. Unless the run is watched, the time that a window takes
        after the answer of the network is part of the first lap of the next window.
        """
        policy, agents, network, situation = self.policy, self._agents, self._network, self.situation
        windows_ns, quiet_ns = self.run.windows_ns, self._digest.quiet_ns
        looking = policy if isinstance(policy, LookingAhead) else None
        knows_end, lap = policy.knows_end, self._wall_time.lap
        watched = self._observer is not None or tell is not None
        self._wall_time.start()
        for _ in islice(repeat(None), most_windows):
            begin_ns = situation.now_ns
            if begin_ns >= to_ns:
                break
            if looking is not None:
                end_ns, sent, states, known = self._look_ahead(looking, begin_ns, to_ns)
                last_ns = end_ns - 1
            else:
                end_ns = self._next_window(begin_ns, to_ns)
                lap("exchange")
                # The end of a window belongs to it where the network knows the states at it.
                last_ns = end_ns if knows_end else end_ns - 1
                sent, states = agents.advance(begin_ns, last_ns, end_ns)
                lap("agents")
                known = states if knows_end else agents.with_new(situation.states, states)
            entered, packets, ended = _NOTHING
            if sent or self._held:
                entered, packets = self._enter(sent, begin_ns, known)
                lap("exchange")
            try:
                arrivals, drops = network.advance(last_ns, packets, known)
            except Exception as error:
                raise failed(error, "network", f"advance from {seconds(begin_ns)} to {seconds(last_ns)}") from error
            lap("network")
            self.commits = watched
            if entered or arrivals or drops:
                ended = self._end(arrivals, drops, begin_ns, last_ns, end_ns)
                self._digest.window(end_ns, entered, ended)
            else:
                quiet_ns.append(end_ns)
            windows_ns.append(end_ns)
            situation.now_ns, situation.states = end_ns, states
            if watched:
                lap("exchange")
                self._watch(begin_ns, entered, ended, known, tell=tell)
                self._wall_time.start()

    def _next_window(self, begin_ns: int, to_ns: int) -> int:
        try:
            end_ns = self.policy.next_window(self.situation)
        except PolicyError:
            raise
        except Exception as error:
            asked = f"say when the window ends that begins at {seconds(begin_ns)}"
            raise failed(error, f"policy {self.policy.name}", asked) from error
        if end_ns is None or end_ns > to_ns:
            return to_ns
        if end_ns <= begin_ns:
            self._stand(begin_ns, end_ns)
        return end_ns

    def _look_ahead(
        self, policy: LookingAhead, begin_ns: int, to_ns: int
    ) -> tuple[int, list[Sent], Mapping[str, State], Mapping[str, State]]:
        """Let agents go ahead of the network in a window, as far as the policy sees that they may.

        Returns:
            End of the window; what programs sent in it; states of the agents at its end; states that the network
            assumes.
        """
        agents, situation = self._agents, self.situation
        begin = situation.states
        # A network that cannot let agents move on takes them to stand.
        moving = begin if self._extrapolates else {name: State(one.position_m) for name, one in begin.items()}
        step_ns = situation.physics_step_ns
        # The states are those of the last step, which a window that goes on after a pause need not begin with.
        since_ns = begin_ns // step_ns * step_ns
        self._see(begin_ns, begin, moving, sent=())
        moves_every_ns = policy.moves_on_every_ns(situation)
        known = DeadReckoned(moving, since_ns, moves_every_ns)
        end_ns = self._next_window(begin_ns, to_ns)
        lap = self._wall_time.lap
        lap("exchange")
        sent, states = agents.advance(begin_ns, end_ns - 1, end_ns)
        lap("agents")
        while end_ns < to_ns:
            self._see(end_ns, states, known.at(end_ns), sent)
            try:
                later_ns = min(policy.goes_on(situation), to_ns)
            except Exception as error:
                asked = f"say until when the window goes on that has come to {seconds(end_ns)}"
                raise failed(error, f"policy {policy.name}", asked) from error
            if later_ns <= end_ns:
                break
            lap("exchange")
            more, states = agents.advance(end_ns, later_ns - 1, later_ns)
            lap("agents")
            sent += more
            end_ns = later_ns
        if agents.new:
            begin = agents.with_new(begin, states)
            standing = {name: State(state.position_m) for name, state in begin.items()}
            known = DeadReckoned({**standing, **moving}, since_ns, moves_every_ns)
        return end_ns, sent, states, known if self._extrapolates else begin

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
        for fate in entered:
            source, destination = fate.packet.source, fate.packet.destination
            if source not in self._active or destination not in self._active:
                self._include(source, destination)
        return entered, [fate.packet for fate in entered]

    def _include(self, *names: str) -> None:
        """Let policies that look ahead bound the places of agents that send, or get packets, unannounced."""
        self._active.update(names)
        others = {*self.situation.others, *names}
        self.situation.others = tuple(sorted(others))

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
        tell: Callable[[int], None] | None,
    ) -> None:
        """Let whoever watches know of the window that ends now."""
        end_ns, states = self.situation.now_ns, self.situation.states
        if self._observer is not None:
            decided_by = getattr(self.policy, "decided_by", "")
            wall_s = self._wall_time.window()
            self._observer.window(Window(begin_ns, end_ns, decided_by, entered, ended, states, known, wall_s))
        if tell is not None:
            tell(end_ns)
        self.commits = False
        if self.is_interrupted:
            raise KeyboardInterrupt


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

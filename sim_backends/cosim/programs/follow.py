"""Programs that follow others by what the network delivers of them, and by nothing else.

A state that was received is as old as it took to come, and as its time stamp tells: it is extrapolated to now at its
velocity. So every delay, and every error in the time of a delivery, becomes an error of position: after a time d a
leader that changes its velocity by a per second is a d^2 / 2 off from where it is believed to be. Who hears nothing
for longer than a time-out stops.

`FollowAtHeadway` keeps a constant time headway h, so a distance r + h v. With the error e = gap - r - h v it
accelerates by ((v_leader - v) + k e) / h, so that e shrinks by exp(-k t) (Ioannou and Chien, "Autonomous intelligent
cruise control", IEEE Trans. Veh. Technol. 42, 1993). With a leader that is heard with the delay d and
extrapolated, from leader to follower

    Gamma(s) = exp(-d s) (s + k (1 + d s)) / ((h s + 1) (s + k)).

A row of such vehicles is string stable if |Gamma(jw)| <= 1 for all w (Ploeg, van de Wouw and Nijmeijer, "Lp string
stability of cascaded systems", IEEE Trans. Control Syst. Technol. 22, 2014): here, as |Gamma|^2 - 1 has the
sign of (1 + k d)^2 - 1 - (h k)^2 - (h w)^2, if d <= (sqrt(1 + (h k)^2) - 1) / k.
"""

import math
from collections.abc import Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.federates import Action
from sim_backends.cosim.programs.beats import PERIOD_NS, Beat, NeverSends
from sim_backends.cosim.programs.way_points import drive_towards
from sim_backends.network.packets import Received
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.dead_reckoning import moved_on
from sim_backends.world.motion import State

TIMEOUT_NS: Final = 1_000_000_000
"""After how long without a state a follower stops, if it is not told otherwise."""


class LatestStates:
    """What was heard last of others.

    Args:
        names: The others.
        timeout_ns: For how long a state is believed, from when it arrived.
    """

    def __init__(self, names: Sequence[str], timeout_ns: int) -> None:
        if not names or timeout_ns <= 0:
            raise ConfigurationError(
                f"nobody to follow, or a time-out of {timeout_ns} ns", remedy="name a leader, and a time-out above 0"
            )
        self._names = tuple(names)
        self._timeout_ns = timeout_ns
        self._last: dict[str, Received] = {}

    def hear(self, received: Sequence[Received]) -> None:
        """Keep the newest state of each, by its time stamp."""
        for one in received:
            known = self._last.get(one.source)
            if isinstance(one.payload, State) and (known is None or one.sent_ns >= known.sent_ns):
                self._last[one.source] = one

    def now(self, now_ns: int) -> list[State]:
        """Return where those are now that are believed, as far as one knows who hears them."""
        heard = (self._last[name] for name in self._names if name in self._last)
        return [
            moved_on(one.payload, (now_ns - one.sent_ns) / 1e9)
            for one in heard
            if now_ns - one.arrived_ns <= self._timeout_ns
        ]


class FollowAtHeadway(NeverSends):
    """Drives behind a leader at a constant time headway.

    Args:
        leader: Whom it follows; its states have to come over the network.
        headway_s: Time by which it is behind.
        standstill_m: How far behind it stands, from antenna to antenna.
        gain_per_s: By what an error of the distance shrinks.
        top_speed_m_s: The most that it drives.
        period_ns: From one command to the next.
        timeout_ns: After how long without a state it stops.
        begin_ns: When it is steered first.

    Raises:
        ConfigurationError: A number of these is not above 0.
    """

    def __init__(
        self,
        leader: str,
        *,
        headway_s: float = 1.0,
        standstill_m: float = 2.0,
        gain_per_s: float = 1.0,
        top_speed_m_s: float = math.inf,
        period_ns: int = PERIOD_NS,
        timeout_ns: int = TIMEOUT_NS,
        begin_ns: int = 0,
    ) -> None:
        if min(headway_s, standstill_m, gain_per_s, top_speed_m_s, period_ns) <= 0:
            raise ConfigurationError(
                f"nobody follows {leader} {headway_s:g} s and {standstill_m:g} m behind at up to "
                f"{top_speed_m_s:g} m/s, with a gain of {gain_per_s:g}/s and every {period_ns} ns",
                remedy="all of these have to be above 0",
            )
        self._heard = LatestStates([leader], timeout_ns)
        self._headway_s = headway_s
        self._standstill_m = standstill_m
        self._gain_per_s = gain_per_s
        self._top_speed_m_s = top_speed_m_s
        self._period_s = period_ns / 1e9
        self._beat = Beat(period_ns, begin_ns)

    def next_wake_ns(self) -> int:
        """See `Program.next_wake_ns`."""
        return self._beat.next_ns

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """See `Program.wake`."""
        self._heard.hear(received)
        if not self._beat.is_due(now_ns):
            return Action()
        leaders = self._heard.now(now_ns)
        return Action(command=self._steer(own, leaders[0]) if leaders else Twist())

    def _steer(self, own: State, leader: State) -> Twist:
        e, n = (there - here for here, there in zip(own.position_m[:2], leader.position_m[:2], strict=True))
        gap_m = math.hypot(e, n)
        if not gap_m:
            return Twist()
        ahead_m_s = (leader.velocity_m_s[0] * e + leader.velocity_m_s[1] * n) / gap_m
        speed_m_s = math.hypot(*own.velocity_m_s[:2])
        error_m = gap_m - self._standstill_m - self._headway_s * speed_m_s
        wanted_m_s2 = (ahead_m_s - speed_m_s + self._gain_per_s * error_m) / self._headway_s
        wanted_m_s = speed_m_s + wanted_m_s2 * self._period_s
        return drive_towards(own, leader.position_m[:2], min(max(wanted_m_s, 0.0), self._top_speed_m_s))


class HoldStation(NeverSends):
    """Flies over the middle of others, at their mean velocity and what brings it there.

    Args:
        leaders: The others; their states have to come over the network.
        above_m: How far over them.
        top_speed_m_s: The most by which it goes after them.
        gain_per_s: Speed for each metre that it is off.
        period_ns: From one command to the next.
        timeout_ns: After how long without a state one is left out; without any it hovers.
        begin_ns: When it is steered first.

    Raises:
        ConfigurationError: There is nobody, or a number of these is not above 0.
    """

    def __init__(
        self,
        leaders: Sequence[str],
        *,
        above_m: float = 10.0,
        top_speed_m_s: float = 5.0,
        gain_per_s: float = 1.0,
        period_ns: int = PERIOD_NS,
        timeout_ns: int = TIMEOUT_NS,
        begin_ns: int = 0,
    ) -> None:
        if min(above_m, top_speed_m_s, gain_per_s, period_ns) <= 0:
            raise ConfigurationError(
                f"nobody flies {above_m:g} m over others at up to {top_speed_m_s:g} m/s with a gain of "
                f"{gain_per_s:g}/s, steered every {period_ns} ns",
                remedy="all of these have to be above 0",
            )
        self._heard = LatestStates(leaders, timeout_ns)
        self._above_m = above_m
        self._top_speed_m_s = top_speed_m_s
        self._gain_per_s = gain_per_s
        self._beat = Beat(period_ns, begin_ns)

    def next_wake_ns(self) -> int:
        """See `Program.next_wake_ns`."""
        return self._beat.next_ns

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """See `Program.wake`."""
        self._heard.hear(received)
        if not self._beat.is_due(now_ns):
            return Action()
        leaders = self._heard.now(now_ns)
        return Action(command=self._steer(own, leaders) if leaders else Velocity())

    def _steer(self, own: State, leaders: Sequence[State]) -> Velocity:
        e, n, u = _mean([leader.position_m for leader in leaders])
        off_m = [there - here for here, there in zip(own.position_m, (e, n, u + self._above_m), strict=True)]
        after = min(self._gain_per_s, self._top_speed_m_s / (math.hypot(*off_m) or math.inf))
        v_e, v_n, v_u = _mean([leader.velocity_m_s for leader in leaders])
        return Velocity((v_e + after * off_m[0], v_n + after * off_m[1], v_u + after * off_m[2]))


def _mean(vectors: Sequence[Vector]) -> Vector:
    east, north, up = (sum(parts) / len(vectors) for parts in zip(*vectors, strict=True))
    return east, north, up

"""Programs that follow other agents, using only the states that the network delivers.

The age of a received state is its transmission delay, which follows from its time stamp. The state is extrapolated
to the current time with its velocity. Every delay, and every error of a delivery time, therefore becomes a position
error: after a time d, a leader with the acceleration a is a d^2 / 2 away from its extrapolated position. A follower
stops, or hovers, if no state of a leader has arrived for longer than a timeout.

`FollowAtHeadway` keeps a constant time headway h: at the speed v, the distance is r + h v, where r is the distance at
standstill. With the error e = gap - r - h v its acceleration is ((v_leader - v) + k e) / h, so that e decays as
exp(-k t) (Ioannou and Chien, "Autonomous intelligent cruise control", IEEE Trans. Veh. Technol. 42, 1993). For a
leader whose states arrive with the delay d and are extrapolated, the transfer function from leader to follower is

    Gamma(s) = exp(-d s) (s + k (1 + d s)) / ((h s + 1) (s + k)).

A row of such vehicles is string stable if |Gamma(jw)| <= 1 for all w (Ploeg, van de Wouw and Nijmeijer, "Lp string
stability of cascaded systems", IEEE Trans. Control Syst. Technol. 22, 2014). Since |Gamma|^2 - 1 has the sign of
(1 + k d)^2 - 1 - (h k)^2 - (h w)^2, this row is string stable if d <= (sqrt(1 + (h k)^2) - 1) / k.
"""

import math
from collections.abc import Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.federates import Action
from sim_backends.cosim.programs.way_points import PERIOD_NS, NeverSends, PeriodicTimer, drive_towards
from sim_backends.network.packets import ReceivedDatagram
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.dead_reckoning import extrapolate
from sim_backends.world.motion import State

TIMEOUT_NS: Final = 1_000_000_000
"""Default time without a state after which a follower stops."""


class LatestStates:
    """The latest states that were received from other agents.

    Args:
        names: The other agents.
        timeout_ns: Time for which a state is valid after its arrival.

    Raises:
        ConfigurationError: There are no other agents, or the timeout is not above 0.
    """

    def __init__(self, names: Sequence[str], timeout_ns: int) -> None:
        if not names or timeout_ns <= 0:
            raise ConfigurationError(
                f"there is no agent to follow, or the timeout of {timeout_ns} ns is not above 0",
                remedy="name a leader, and a timeout above 0",
            )
        self._names = tuple(names)
        self._timeout_ns = timeout_ns
        self._latest: dict[str, ReceivedDatagram] = {}

    def update(self, received_datagrams: Sequence[ReceivedDatagram]) -> None:
        """Store the state with the latest time stamp for each agent."""
        for datagram in received_datagrams:
            latest = self._latest.get(datagram.source)
            if isinstance(datagram.payload, State) and (latest is None or datagram.sent_ns >= latest.sent_ns):
                self._latest[datagram.source] = datagram

    def at(self, now_ns: int) -> list[State]:
        """Return the extrapolated states of the agents whose latest state is still valid."""
        latest = (self._latest[name] for name in self._names if name in self._latest)
        return [
            extrapolate(datagram.payload, (now_ns - datagram.sent_ns) / 1e9)
            for datagram in latest
            if now_ns - datagram.arrived_ns <= self._timeout_ns
        ]


class FollowAtHeadway(NeverSends):
    """Drives behind a leader at a constant time headway.

    Args:
        leader: Name of the leader, whose states must arrive over the network.
        headway_s: Time headway.
        standstill_m: Distance at standstill, from antenna to antenna.
        gain_per_s: Rate at which an error of the distance decays.
        top_speed_m_s: Top speed.
        period_ns: Time between commands.
        timeout_ns: Time without a state after which the follower stops.
        begin_ns: Time of the first command.

    Raises:
        ConfigurationError: One of these numbers, except `begin_ns`, is not above 0.
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
                f"cannot follow {leader} with a headway of {headway_s:g} s, a distance at standstill of "
                f"{standstill_m:g} m, a top speed of {top_speed_m_s:g} m/s, a gain of {gain_per_s:g}/s, and "
                f"{period_ns} ns between commands",
                remedy="set all of these to values above 0",
            )
        self._leader = LatestStates([leader], timeout_ns)
        self._headway_s = headway_s
        self._standstill_m = standstill_m
        self._gain_per_s = gain_per_s
        self._top_speed_m_s = top_speed_m_s
        self._period_s = period_ns / 1e9
        self._timer = PeriodicTimer(period_ns, begin_ns)

    def next_wake_ns(self) -> int:
        """Return the time of the next command."""
        return self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:
        """Store received states; if a command is due, steer, or stop if there is no valid state."""
        self._leader.update(received_datagrams)
        if not self._timer.fire_if_due(now_ns):
            return Action()
        leaders = self._leader.at(now_ns)
        return Action(command=self._command(own_state, leaders[0]) if leaders else Twist())

    def _command(self, own_state: State, leader: State) -> Twist:
        e, n = (
            target - position
            for position, target in zip(own_state.position_m[:2], leader.position_m[:2], strict=True)
        )
        gap_m = math.hypot(e, n)
        if not gap_m:
            return Twist()
        # Speed of the leader in the direction from the follower to the leader.
        leader_m_s = (leader.velocity_m_s[0] * e + leader.velocity_m_s[1] * n) / gap_m
        speed_m_s = math.hypot(*own_state.velocity_m_s[:2])
        error_m = gap_m - self._standstill_m - self._headway_s * speed_m_s
        acceleration_m_s2 = (leader_m_s - speed_m_s + self._gain_per_s * error_m) / self._headway_s
        target_m_s = speed_m_s + acceleration_m_s2 * self._period_s
        return drive_towards(own_state, leader.position_m[:2], min(max(target_m_s, 0.0), self._top_speed_m_s))


class HoldStation(NeverSends):
    """Flies above the centre of other agents, at their mean velocity plus a correction towards that point.

    Args:
        leaders: The other agents, whose states must arrive over the network.
        above_m: Height above them.
        top_speed_m_s: Largest correction of the velocity.
        gain_per_s: Speed per metre of distance from that point.
        period_ns: Time between commands.
        timeout_ns: Time without a state after which a leader is ignored; if all leaders are ignored, the follower
            hovers.
        begin_ns: Time of the first command.

    Raises:
        ConfigurationError: There are no leaders, or one of these numbers, except `begin_ns`, is not above 0.
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
                f"cannot fly {above_m:g} m above other agents with a top speed of {top_speed_m_s:g} m/s, a gain of "
                f"{gain_per_s:g}/s, and {period_ns} ns between commands",
                remedy="set all of these to values above 0",
            )
        self._leaders = LatestStates(leaders, timeout_ns)
        self._above_m = above_m
        self._top_speed_m_s = top_speed_m_s
        self._gain_per_s = gain_per_s
        self._timer = PeriodicTimer(period_ns, begin_ns)

    def next_wake_ns(self) -> int:
        """Return the time of the next command."""
        return self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:
        """Store received states; if a command is due, steer, or hover if there is no valid state."""
        self._leaders.update(received_datagrams)
        if not self._timer.fire_if_due(now_ns):
            return Action()
        leaders = self._leaders.at(now_ns)
        return Action(command=self._command(own_state, leaders) if leaders else Velocity())

    def _command(self, own_state: State, leaders: Sequence[State]) -> Velocity:
        e, n, u = _mean([leader.position_m for leader in leaders])
        offset_m = [
            target - position
            for position, target in zip(own_state.position_m, (e, n, u + self._above_m), strict=True)
        ]
        gain_per_s = min(self._gain_per_s, self._top_speed_m_s / (math.hypot(*offset_m) or math.inf))
        v_e, v_n, v_u = _mean([leader.velocity_m_s for leader in leaders])
        return Velocity(
            (v_e + gain_per_s * offset_m[0], v_n + gain_per_s * offset_m[1], v_u + gain_per_s * offset_m[2])
        )


def _mean(vectors: Sequence[Vector]) -> Vector:
    east, north, up = (sum(parts) / len(vectors) for parts in zip(*vectors, strict=True))
    return east, north, up

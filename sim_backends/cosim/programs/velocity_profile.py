"""Programs that command a sequence of velocities, without feedback."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.federates import Action
from sim_backends.cosim.programs.beats import NeverSends, PeriodicTimer
from sim_backends.network.packets import Received
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State


@dataclass(frozen=True, slots=True)
class ProfileLeg:
    """A part of a velocity profile.

    Attributes:
        duration_ns: Its duration.
        command: The command to the body.
    """

    duration_ns: int
    command: Twist | Velocity


class VelocityProfile(NeverSends):
    """Commands one leg after the other, and then stops.

    Args:
        legs: The legs.
        begin_ns: Beginning of the first leg.

    Raises:
        ConfigurationError: There are no legs, or the duration of one is not above 0.
    """

    def __init__(self, legs: Sequence[ProfileLeg], *, begin_ns: int = 0) -> None:
        if not legs or any(leg.duration_ns <= 0 for leg in legs):
            raise ConfigurationError(
                f"a velocity profile of {len(legs)} legs has no duration", remedy="add legs with a duration above 0"
            )
        stop = Twist() if isinstance(legs[-1].command, Twist) else Velocity()
        self._commands = [*(leg.command for leg in legs), stop]
        self._times_ns = list(accumulate((leg.duration_ns for leg in legs), initial=begin_ns))
        self._next = 0

    def next_wake_ns(self) -> int | None:
        """Return the beginning of the next leg, or None after the last."""
        return self._times_ns[self._next] if self._next < len(self._times_ns) else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Send the command of the leg that has begun, if any."""
        due = bisect_right(self._times_ns, now_ns)
        if due == self._next:
            return Action()
        self._next = due
        return Action(command=self._commands[due - 1])


class SpeedOscillation(NeverSends):
    """Drives straight ahead at a speed that oscillates as a sine; used to measure string stability.

    Args:
        mean_m_s: Mean of the speed.
        amplitude_m_s: Amplitude of the oscillation.
        period_s: Period of the oscillation.
        every_ns: Time between commands.

    Raises:
        ConfigurationError: A period is not above 0.
    """

    def __init__(self, mean_m_s: float, amplitude_m_s: float, period_s: float, *, every_ns: int = 10_000_000) -> None:
        if not 0 < period_s < math.inf:
            raise ConfigurationError(f"a period of {period_s:g} s is not above 0", remedy="set a period above 0")
        self._mean_m_s = mean_m_s
        self._amplitude_m_s = amplitude_m_s
        self._rate_rad_s = math.tau / period_s
        self._timer = PeriodicTimer(every_ns)

    def next_wake_ns(self) -> int:
        """Return the time of the next command."""
        return self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Send the present speed if a command is due."""
        if not self._timer.fire_if_due(now_ns):
            return Action()
        return Action(command=Twist(self._mean_m_s + self._amplitude_m_s * math.sin(self._rate_rad_s * now_ns / 1e9)))

"""Programs that tell a body one velocity after the other, whatever it senses."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.federates import Action
from sim_backends.cosim.programs.beats import Beat, NeverSends
from sim_backends.network.packets import Received
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State


@dataclass(frozen=True, slots=True)
class ProfileLeg:
    """A part of a velocity profile.

    Attributes:
        duration_ns: How long it lasts.
        command: What the body is told.
    """

    duration_ns: int
    command: Twist | Velocity


class VelocityProfile(NeverSends):
    """Goes from leg to leg, and stands after the last.

    Args:
        legs: The legs.
        begin_ns: When the first begins.

    Raises:
        ConfigurationError: There is no leg, or one that lasts no time.
    """

    def __init__(self, legs: Sequence[ProfileLeg], *, begin_ns: int = 0) -> None:
        if not legs or any(leg.duration_ns <= 0 for leg in legs):
            raise ConfigurationError(
                f"a velocity profile of {len(legs)} legs lasts no time", remedy="give it legs that last longer than 0"
            )
        stop = Twist() if isinstance(legs[-1].command, Twist) else Velocity()
        self._commands = [*(leg.command for leg in legs), stop]
        self._times_ns = list(accumulate((leg.duration_ns for leg in legs), initial=begin_ns))
        self._next = 0

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        return self._times_ns[self._next] if self._next < len(self._times_ns) else None

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`."""
        due = bisect_right(self._times_ns, now_ns)
        if due == self._next:
            return Action()
        self._next = due
        return Action(command=self._commands[due - 1])


class SpeedOscillation(NeverSends):
    """Drives straight ahead at a speed that goes up and down as a sine, by which string stability is measured.

    Args:
        mean_m_s: The mean of the speed.
        amplitude_m_s: How far it goes up and down.
        period_s: From one maximum to the next.
        every_ns: From one command to the next.

    Raises:
        ConfigurationError: The oscillation has no period, or no time passes from one command to the next.
    """

    def __init__(self, mean_m_s: float, amplitude_m_s: float, period_s: float, *, every_ns: int = 10_000_000) -> None:
        if not 0 < period_s < math.inf:
            raise ConfigurationError(f"no speed oscillates every {period_s:g} s", remedy="give it a period above 0")
        self._mean_m_s = mean_m_s
        self._amplitude_m_s = amplitude_m_s
        self._rate_rad_s = math.tau / period_s
        self._beat = Beat(every_ns)

    def next_wake_ns(self) -> int:
        """See `Program.next_wake_ns`."""
        return self._beat.next_ns

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`."""
        if not self._beat.is_due(now_ns):
            return Action()
        return Action(command=Twist(self._mean_m_s + self._amplitude_m_s * math.sin(self._rate_rad_s * now_ns / 1e9)))

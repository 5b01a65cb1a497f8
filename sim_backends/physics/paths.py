"""Physics of agents whose motion is known in advance: way-points and velocity profiles."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from sim_backends.world.motion import Motion, State

STEP_NS: Final = 1_000_000
"""Gazebo's and ns-3 co-simulations' usual step, 1 ms."""


class Paths:
    """Moves agents along given motions, in steps; commands change nothing.

    Args:
        motions: The motions; no two move the same agent.
        step_ns: Own step: states are those at whole steps.
        limits_m_s2: The most that each agent's velocity changes per second; 0 for those left out, which is true of
            who goes straight at one speed.
    """

    def __init__(
        self, motions: Sequence[Motion], *, step_ns: int = STEP_NS, limits_m_s2: Mapping[str, float] | None = None
    ) -> None:
        self._motions = tuple(motions)
        self.step_ns = step_ns
        self._at_ns = 0
        self._states = self._at(0)
        self.limits_m_s2: Mapping[str, float] = dict.fromkeys(self._states, 0.0) | dict(limits_m_s2 or {})

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:  # noqa: ARG002 (see PhysicsFederate)
        """See `PhysicsFederate.advance`."""
        at_ns = to_ns // self.step_ns * self.step_ns
        if at_ns != self._at_ns:
            self._at_ns, self._states = at_ns, self._at(at_ns)
        return self._states

    def _at(self, time_ns: int) -> Mapping[str, State]:
        return {name: state for motion in self._motions for name, state in motion.at(time_ns).items()}

"""Physics of agents with prescribed motion: waypoints and velocity profiles."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from sim_backends.world.motion import Motion, State, WayPoints

STEP_NS: Final = 1_000_000
"""The default step of Gazebo, also common in ns-3 co-simulations: 1 ms."""


class Paths:
    """Moves agents along prescribed motions, in steps; commands have no effect.

    Args:
        motions: The motions; no two of them move the same agent.
        step_ns: Time step; there are states only at whole steps.
        limits_m_s2: Maximum acceleration of some agents. The limit of any other agent is computed from the corners of
            its `WayPoints`, or is infinite if its motion is of another kind.
    """

    def __init__(
        self, motions: Sequence[Motion], *, step_ns: int = STEP_NS, limits_m_s2: Mapping[str, float] | None = None
    ) -> None:
        self._motions = tuple(motions)
        self._waypoints = {motion.name: motion for motion in motions if isinstance(motion, WayPoints)}
        self.step_ns = step_ns
        self._at_ns = 0
        self._states = self._at(0)
        self.limits_m_s2: Mapping[str, float] = PathLimits(self, dict(limits_m_s2 or {}))

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:  # noqa: ARG002 (see PhysicsFederate)
        """Implement `PhysicsFederate.advance`."""
        at_ns = to_ns // self.step_ns * self.step_ns
        if at_ns != self._at_ns:
            self._at_ns, self._states = at_ns, self._at(at_ns)
        return self._states

    def limit_m_s2(self, name: str) -> float:
        """Return the computed limit of an agent; it is valid from the time of the last returned states."""
        waypoints = self._waypoints.get(name)
        return math.inf if waypoints is None else waypoints.limit_m_s2(self._at_ns)

    @property
    def names(self) -> frozenset[str]:
        """Names of the agents that it moves now."""
        return frozenset(self._states)

    def _at(self, time_ns: int) -> Mapping[str, State]:
        return {name: state for motion in self._motions for name, state in motion.at(time_ns).items()}


class PathLimits(Mapping[str, float]):
    """The maximum acceleration of each agent of `Paths`."""

    def __init__(self, paths: Paths, limits_m_s2: Mapping[str, float]) -> None:
        self._paths = paths
        self._limits_m_s2 = limits_m_s2

    def __getitem__(self, name: str) -> float:
        given_m_s2 = self._limits_m_s2.get(name)
        return self._paths.limit_m_s2(name) if given_m_s2 is None else given_m_s2

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths.names)

    def __len__(self) -> int:
        return len(self._paths.names)

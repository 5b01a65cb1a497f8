"""Positions of agents, sampled at equal times in several runs, independently of their windows."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_backends.cosim.federates import PhysicsFederate
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.world.motion import State


@dataclass(frozen=True)
class Tracks:
    """Positions of agents over time.

    Attributes:
        names: The agents.
        times_s: Times, shape (times,).
        places_m: Positions in metres east, north, up, shape (times, agents, 3).
    """

    names: Sequence[str]
    times_s: Floats
    places_m: Floats

    def distances_m(self, other: "Tracks") -> Floats:
        """Return the distance of each agent from its position in another run, shape (common times, agents)."""
        shorter = min(len(self.times_s), len(other.times_s))
        distances_m: Floats = np.linalg.norm(self.places_m[:shorter] - other.places_m[:shorter], axis=2)
        return distances_m


def tracks_of(states: Iterable[tuple[int, str, State]]) -> Tracks:
    """Return the tracks of recorded states; each of their times must have the states of all agents.

    Args:
        states: Time in nanoseconds, agent, state, in the order of time.
    """
    by_time: dict[int, dict[str, State]] = {}
    for at_ns, name, state in states:
        by_time.setdefault(at_ns, {})[name] = state
    return _tracks(np.array([*by_time], dtype=np.float64) / 1e9, [*by_time.values()])


def _tracks(times_s: Floats, samples: Sequence[Mapping[str, State]]) -> Tracks:
    names = tuple(samples[0]) if samples else ()
    places_m = [[states[name].position_m for name in names] for states in samples]
    return Tracks(names, times_s, np.array(places_m, dtype=np.float64).reshape(len(samples), len(names), 3))


class SampledPhysics:
    """Physics whose states are sampled at equal intervals, which does not change the motion.

    Args:
        physics: The physics.
        interval_ns: Sampling interval; it is rounded up to whole steps of the physics.
    """

    def __init__(self, physics: PhysicsFederate, interval_ns: int) -> None:
        self._physics = physics
        self._interval_ns = -(-interval_ns // physics.step_ns) * physics.step_ns
        self._next_ns = 0
        self._samples: list[Mapping[str, State]] = []
        self.step_ns = physics.step_ns
        self.limits_m_s2 = physics.limits_m_s2

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Advance the physics, and take the samples that are due."""
        while self._next_ns <= to_ns:
            self._samples.append(self._physics.advance(self._next_ns, commands))
            self._next_ns += self._interval_ns
            commands = {}
        return self._physics.advance(to_ns, commands)

    @property
    def tracks(self) -> Tracks:
        """The samples so far."""
        times_s = np.arange(len(self._samples), dtype=np.float64) * (self._interval_ns / 1e9)
        return _tracks(times_s, self._samples)

"""Where agents are at equal times of several runs, whatever their windows."""

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
        times_s: When, shape (times,).
        places_m: Metres east, north, up, shape (times, agents, 3).
    """

    names: Sequence[str]
    times_s: Floats
    places_m: Floats

    def apart_m(self, other: "Tracks") -> Floats:
        """Return how far each agent is from where it is in another run, as long as both go, shape (times, agents)."""
        shorter = min(len(self.times_s), len(other.times_s))
        apart_m: Floats = np.linalg.norm(self.places_m[:shorter] - other.places_m[:shorter], axis=2)
        return apart_m


def tracks_of(states: Iterable[tuple[int, str, State]]) -> Tracks:
    """Return the tracks of states as a recording has them, of all agents at each of its times.

    Args:
        states: When in nanoseconds, whose, and what, in the order of time.
    """
    seen: dict[int, dict[str, State]] = {}
    for at_ns, name, state in states:
        seen.setdefault(at_ns, {})[name] = state
    return _tracks(np.array([*seen], dtype=np.float64) / 1e9, [*seen.values()])


def _tracks(times_s: Floats, seen: Sequence[Mapping[str, State]]) -> Tracks:
    names = tuple(seen[0]) if seen else ()
    places_m = [[states[name].position_m for name in names] for states in seen]
    return Tracks(names, times_s, np.array(places_m, dtype=np.float64).reshape(len(seen), len(names), 3))


class Tracked:
    """Physics whose agents are looked at in equal intervals; how they move it leaves as it is.

    Args:
        physics: The physics.
        interval_ns: From one look to the next: whole steps of the physics.
    """

    def __init__(self, physics: PhysicsFederate, interval_ns: int) -> None:
        self._physics = physics
        self._interval_ns = -(-interval_ns // physics.step_ns) * physics.step_ns
        self._next_ns = 0
        self._seen: list[Mapping[str, State]] = []
        self.step_ns = physics.step_ns
        self.limits_m_s2 = physics.limits_m_s2

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """See `PhysicsFederate.advance`."""
        while self._next_ns <= to_ns:
            self._seen.append(self._physics.advance(self._next_ns, commands))
            self._next_ns += self._interval_ns
            commands = {}
        return self._physics.advance(to_ns, commands)

    @property
    def tracks(self) -> Tracks:
        """What was seen so far."""
        return _tracks(np.arange(len(self._seen), dtype=np.float64) * (self._interval_ns / 1e9), self._seen)

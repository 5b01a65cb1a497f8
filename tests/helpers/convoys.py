"""A row of robots, each of which follows the one before it by what it hears over a network with a constant delay."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Program
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.programs.follow import FollowAtHeadway
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.programs.several import Several
from sim_backends.cosim.programs.velocity_profile import SpeedOscillation
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.network.disc import Disc
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.differential_drive import DifferentialDrive, DriveLimits
from sim_backends.world.motion import State

MS = 1_000_000
QUICK = DriveLimits(3.0, 20.0, 2.0, 6.0, radius_m=0.3, height_m=0.4)
"""A robot whose own limits hardly matter, so that a row of it is linear."""
STANDSTILL_M = 2.0
MEAN_M_S = 1.0
EVERY_NS = 10 * MS


def places_m(
    policy: SyncPolicy,
    *,
    delay_s: float,
    headway_s: float,
    gain_per_s: float = 2.0,
    rate_rad_s: float = 2.0,
    followers: int = 1,
    period_ms: int = 10,
    seconds: float,
) -> tuple[Floats, Floats]:
    """Return where robots are, the first's speed going up and down: times, and places as (times, robots, 3)."""
    names = [f"v{number}" for number in range(followers + 1)]
    # The row starts as it would go at the mean speed.
    apart_m = STANDSTILL_M + headway_s * MEAN_M_S
    bodies = Bodies({name: DifferentialDrive(QUICK, (-apart_m * number, 0.0)) for number, name in enumerate(names)})
    programs: dict[str, Program] = {}
    for number, name in enumerate(names):
        parts: list[Program] = [
            FollowAtHeadway(
                names[number - 1],
                headway_s=headway_s,
                standstill_m=STANDSTILL_M,
                gain_per_s=gain_per_s,
                period_ns=period_ms * MS,
            )
            if number
            else SpeedOscillation(MEAN_M_S, 0.2, math.tau / rate_rad_s)
        ]
        parts += [Periodic(name, behind, period_ns=period_ms * MS) for behind in names[number + 1 : number + 2]]
        programs[name] = Several(parts)
    watched = Watched(bodies)
    network = Disc(1e6, round(delay_s * 1e9))
    Coordinator(Agents(watched, programs), network, policy, [*pairwise(names)]).advance(round(seconds * 1e9))
    places = [[states[name].position_m for name in names] for states in watched.seen]
    return np.arange(len(places)) * EVERY_NS / 1e9, np.array(places)


class Watched:
    """Bodies that are looked at in equal intervals; how they move it leaves as it is."""

    def __init__(self, bodies: Bodies) -> None:
        self._bodies = bodies
        self.seen: list[Mapping[str, State]] = []
        self.step_ns = bodies.step_ns
        self.limits_m_s2 = bodies.limits_m_s2

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        while len(self.seen) * EVERY_NS <= to_ns:
            self.seen.append(self._bodies.advance(len(self.seen) * EVERY_NS, commands))
            commands = {}
        return self._bodies.advance(to_ns, commands)

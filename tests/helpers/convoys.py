"""A convoy of robots, each of which follows its predecessor by messages over a network with a constant delay."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Program
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.programs.follow import FollowAtHeadway
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.programs.way_points import SpeedOscillation
from sim_backends.cosim.programs.wrappers import CombinedProgram
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.network.disc import Disc
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.robot_limits import DriveLimits
from sim_backends.world.motion import State

MS = 1_000_000
QUICK = DriveLimits(3.0, 20.0, 2.0, 6.0, radius_m=0.3, height_m=0.4)
"""Limits so high that they hardly have an effect, so the convoy is a linear system."""
STANDSTILL_M = 2.0
MEAN_M_S = 1.0
SAMPLE_INTERVAL_NS = 10 * MS


def positions_m(
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
    """The times, and the positions of shape (times, robots, 3), of a convoy whose leader has an oscillating speed."""
    names = [f"v{number}" for number in range(followers + 1)]
    # The initial spacing is the equilibrium at the mean speed.
    spacing_m = STANDSTILL_M + headway_s * MEAN_M_S
    bodies = Bodies({name: DifferentialDrive(QUICK, (-spacing_m * number, 0.0)) for number, name in enumerate(names)})
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
        parts += [Periodic(name, follower, period_ns=period_ms * MS) for follower in names[number + 1 : number + 2]]
        programs[name] = CombinedProgram(parts)
    sampled_bodies = SampledBodies(bodies)
    network = Disc(1e6, round(delay_s * 1e9))
    Coordinator(Agents(sampled_bodies, programs), network, policy, [*pairwise(names)]).advance(round(seconds * 1e9))
    positions = [[states[name].position_m for name in names] for states in sampled_bodies.samples]
    return np.arange(len(positions)) * SAMPLE_INTERVAL_NS / 1e9, np.array(positions)


class SampledBodies:
    """Bodies whose states are sampled at equal intervals, without an effect on their motion."""

    def __init__(self, bodies: Bodies) -> None:
        self._bodies = bodies
        self.samples: list[Mapping[str, State]] = []
        self.step_ns = bodies.step_ns
        self.limits_m_s2 = bodies.limits_m_s2

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        while len(self.samples) * SAMPLE_INTERVAL_NS <= to_ns:
            self.samples.append(self._bodies.advance(len(self.samples) * SAMPLE_INTERVAL_NS, commands))
            commands = {}
        return self._bodies.advance(to_ns, commands)

"""A co-simulation that can be worked out on paper: a robot passes another, and publishes to it."""

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.network.disc import Disc
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import WayPoints

SPEED_M_S = 1.7
RANGE_M = 4.0
PERIOD_NS = 3_700_001
DELAY_NS = 1_234_567
STEP_NS = 10_000
"""So short that where somebody is at the last step is where he is."""
ENTERS_NS, LEAVES_NS = 3_529_411_765, 8_235_294_118
"""When the one comes into the other's range, and leaves it: 4 m before and behind 10 m, at 1.7 m/s."""


def moving_pair(policy: SyncPolicy) -> Coordinator:
    """Return a robot that goes straight over another, which stands 10 m before it."""
    physics = Paths(
        [
            WayPoints("a", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)], SPEED_M_S),
            WayPoints("b", [(10.0, 0.0, 0.0)], 1.0),
        ],
        step_ns=STEP_NS,
    )
    agents = Agents(physics, {"a": Periodic("a", "b", period_ns=PERIOD_NS)})
    return Coordinator(agents, Disc(RANGE_M, DELAY_NS), policy, [("a", "b")])

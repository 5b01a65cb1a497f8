"""A co-simulation with an analytic solution: a robot passes another robot and publishes to it."""

from dataclasses import dataclass

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.run_record import Run
from sim_backends.network.disc import Disc
from sim_backends.physics.paths import Paths
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.world.motion import WayPoints

SPEED_M_S = 1.7
RANGE_M = 4.0
PERIOD_NS = 3_700_001
DELAY_NS = 1_234_567
STEP_NS = 10_000
"""The step is so short that the position at the last step is practically the present position."""
ENTERS_NS, LEAVES_NS = 3_529_411_765, 8_235_294_118
"""Times at which the moving robot enters and leaves the range, at 6 m and 14 m with 1.7 m/s."""
END_NS = 10_000_000_000
PAIR_END_NS = 5_000_000_000
WINDOW_S = 0.05


def moving_agents(first_ns: int = 0, step_ns: int = STEP_NS) -> Agents:
    """A robot that drives through the position of another, 10 m ahead, and publishes from `first_ns`."""
    physics = Paths(
        [
            WayPoints("a", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)], SPEED_M_S),
            WayPoints("b", [(10.0, 0.0, 0.0)], 1.0),
        ],
        step_ns=step_ns,
    )
    return Agents(physics, {"a": Periodic("a", "b", period_ns=PERIOD_NS, first_ns=first_ns)})


def moving_pair(policy: SyncPolicy) -> Coordinator:
    """The two robots, with links that exist only within a fixed range."""
    return Coordinator(moving_agents(), Disc(RANGE_M, DELAY_NS, extrapolates=True), policy, [("a", "b")])


def moving_run(policy: SyncPolicy) -> Run:
    """The complete run of the two robots."""
    return moving_pair(policy).advance(END_NS)


@dataclass
class MovingPair:
    """The same scenario with steps of 1 ms; the seed determines the time of the first packet.

    Attributes:
        policy: Name of the sync policy; fixed windows are `WINDOW_S` long.
        seed: The seed.
    """

    policy: str
    seed: int

    def __post_init__(self) -> None:
        self.agents = moving_agents(int(RandomStream(self.seed, "phase").draw(0) * PERIOD_NS), 1_000_000)

    def run(self) -> Run:
        """Run half of the scenario."""
        policy = make_policy(self.policy, window_s=0.0005 if self.policy == "velocity_aware_raw" else WINDOW_S)
        return Coordinator(
            self.agents, Disc(RANGE_M, DELAY_NS, extrapolates=True), policy, [("a", "b"), ("b", "a")]
        ).advance(PAIR_END_NS)

    def close(self) -> None:
        """Do nothing, because there are no external federates."""

"""A co-simulation that can be worked out on paper: a robot passes another, and publishes to it."""

from dataclasses import dataclass

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.policies import make_policy
from sim_backends.network.disc import Disc
from sim_backends.physics.paths import Paths
from sim_backends.radio.random_streams import RandomStream
from sim_backends.world.motion import WayPoints

SPEED_M_S = 1.7
RANGE_M = 4.0
PERIOD_NS = 3_700_001
DELAY_NS = 1_234_567
STEP_NS = 10_000
"""So short that where somebody is at the last step is where he is."""
ENTERS_NS, LEAVES_NS = 3_529_411_765, 8_235_294_118
"""When the one comes into the other's range, and leaves it: 4 m before and behind 10 m, at 1.7 m/s."""
END_NS = 10_000_000_000
PAIR_END_NS = 5_000_000_000
WINDOW_S = 0.05


def moving_agents(first_ns: int = 0, step_ns: int = STEP_NS) -> Agents:
    """Return a robot that goes straight over another, which stands 10 m before it, and publishes from a time on."""
    physics = Paths(
        [
            WayPoints("a", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)], SPEED_M_S),
            WayPoints("b", [(10.0, 0.0, 0.0)], 1.0),
        ],
        step_ns=step_ns,
    )
    return Agents(physics, {"a": Periodic("a", "b", period_ns=PERIOD_NS, first_ns=first_ns)})


def moving_pair(policy: SyncPolicy) -> Coordinator:
    """Return them on links with a hard range limit."""
    return Coordinator(moving_agents(), Disc(RANGE_M, DELAY_NS, extrapolates=True), policy, [("a", "b")])


def moving_run(policy: SyncPolicy) -> Run:
    """Return their whole run."""
    return moving_pair(policy).advance(END_NS)


@dataclass
class MovingPair:
    """The same with steps of 1 ms, ready to run: a seed draws when the first packet is sent.

    Attributes:
        policy: Name of the sync policy; windows are `WINDOW_S` long where they have one length.
        seed: The seed.
    """

    policy: str
    seed: int

    def __post_init__(self) -> None:
        self.agents = moving_agents(int(RandomStream(self.seed, "phase").draw(0) * PERIOD_NS), 1_000_000)

    def run(self) -> Run:
        """Run it for half that time."""
        policy = make_policy(self.policy, window_s=0.0005 if self.policy == "velocity_aware_raw" else WINDOW_S)
        return Coordinator(
            self.agents, Disc(RANGE_M, DELAY_NS, extrapolates=True), policy, [("a", "b"), ("b", "a")]
        ).advance(PAIR_END_NS)

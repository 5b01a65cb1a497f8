"""The simulations of the paper (cited in docs/index.md), and the samples of their flows over seeds."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from fieldkit.core.executors import Workers
from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.packet_columns import round_trips_s
from sim_backends.cosim.policies.window_policies import EventDriven, SlidingWindow, VelocityAware
from sim_backends.cosim.run_record import Fate, Run
from sim_backends.cosim.scenario.agent_plans import PingTraffic
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.seeds import ALL_PROCESSORS, Task, run_many

UNDER_WAY = "under way when the run ended"
"""Reason in `FlowSample.reasons` of a packet that was neither delivered nor dropped."""


@dataclass(frozen=True)
class Setup:
    """A scenario and the policy with which it is run.

    Attributes:
        scenario: The scenario.
        policy: Name of the sync policy.
    """

    scenario: CosimScenario
    policy: str


@dataclass(frozen=True)
class FlowSample:
    """The packets of a flow in one run; for a ping, its requests.

    Attributes:
        sent_packets: Number of packets.
        arrived_packets: Number of packets that arrived or, for a ping, got a reply before the run ended.
        delay_sum_s: Sum of their delays, from sending to the arrival that counts for the receiver, or of round trips;
            nan if none arrived, because 0 would mean an immediate transmission.
        reasons: Number of the packets that did not arrive, by reason. Requests of a ping whose reply did not arrive
            are not included.
    """

    sent_packets: int
    arrived_packets: int
    delay_sum_s: float
    reasons: Mapping[str, int]

    @property
    def loss(self) -> float:
        """Share of the packets that did not arrive; nan without packets."""
        return 1 - self.arrived_packets / self.sent_packets if self.sent_packets else np.nan

    @property
    def delay_mean_s(self) -> float:
        """Mean delay of packets that arrived; nan if no packet arrived."""
        return self.delay_sum_s / self.arrived_packets if self.arrived_packets else np.nan


def flow_samples(
    setups: Mapping[str, Setup],
    seeds: Sequence[int],
    *,
    workers: Workers = ALL_PROCESSORS,
    progress: Callable[[int], None] | None = None,
) -> dict[str, list[dict[str, FlowSample]]]:
    """Return, for each setup and each seed in order, a sample of each flow.

    Args:
        setups: The setups by name.
        seeds: Seeds of the random draws.
        workers: The workers that run the simulations.
        progress: Called with the number of finished runs, or None.

    Raises:
        FieldkitError: A run failed.
    """
    tasks = [Task(setup.policy, seed, name) for name, setup in setups.items() for seed in seeds]
    samples = run_many(partial(_sample, dict(setups)), tasks, workers=workers, progress=progress)
    by_setup: dict[str, list[dict[str, FlowSample]]] = {name: [] for name in setups}
    for task, sample in zip(tasks, samples, strict=True):
        by_setup[task.setup].append(sample)
    return by_setup


def _sample(setups: Mapping[str, Setup], task: Task) -> dict[str, FlowSample]:
    scenario = setups[task.setup].scenario
    run = build(scenario, policy=task.policy, seed=task.seed).run()
    return {
        flow: _round_trips(run, flow) if isinstance(traffic, PingTraffic) else _deliveries(run, flow)
        for traffic in scenario.traffic
        for flow in traffic.flows
    }


def _deliveries(run: Run, flow: str) -> FlowSample:
    fates = _fates(run, flow)
    delays_ns = [fate.counted_ns - fate.packet.sent_ns for fate in fates if fate.counted_ns is not None]
    return _flow_sample(len(fates), [delay_ns / 1e9 for delay_ns in delays_ns], fates)


def _round_trips(run: Run, flow: str) -> FlowSample:
    trips_s = round_trips_s(run, flow)
    finite_trips_s = trips_s[np.isfinite(trips_s)]
    return _flow_sample(len(trips_s), finite_trips_s.tolist(), _fates(run, flow))


def _fates(run: Run, flow: str) -> list[Fate]:
    return [fate for (name, _), fate in run.fates.items() if name == flow]


def _flow_sample(sent_packets: int, delays_s: Sequence[float], fates: Sequence[Fate]) -> FlowSample:
    reasons = Counter(fate.reason or UNDER_WAY for fate in fates if fate.arrived_ns is None)
    return FlowSample(sent_packets, len(delays_s), sum(delays_s) if delays_s else np.nan, dict(reasons))


Changes = Mapping[str, Any]
"""Values that replace values of a scenario file, by dotted key."""

RADIOS: Final[Mapping[str, Changes]] = MappingProxyType(
    {"wifi": MappingProxyType({}), "1 Mbit/s": MappingProxyType({"radio": {"rate": "1Mbit/s"}})}
)
"""Radios of the mesh: the radio of the scenario file, and fixed links as in EMANE's model RF Pipe."""

_DURATION: Final = "20s"
"""The run ends about 9.5 s after the last packet of a bag; packets that are still under way then count as lost."""


def masterless(sight: Sight, distance_m: float, changes: Changes, *, flying: bool = False) -> Setup:
    """Return the setup of a row of tables 1 and 2: a topic from one agent to another.

    Args:
        sight: Line of sight, or no line of sight.
        distance_m: Distance between the two agents, along the world's line for this sight condition.
        changes: Changes that apply to all rows.
        flying: True if the drone sends, instead of a ground robot.
    """
    source, destination, moved_agent = ("iris", "husky-1", "iris") if flying else ("husky-1", "husky-2", "husky-2")
    placements = {f"agents.{moved_agent}.along": f"{distance_m}m"}
    return Setup(_baylands(sight, placements | _bag(source, destination, "topic"), changes), VelocityAware.name)


def master_based(sight: Sight, distance_m: float, protocol: str, changes: Changes) -> Setup:
    """Return the setup of a row of table 3: all packets pass the drone, which hovers halfway.

    Args:
        sight: Line of sight, or no line of sight.
        distance_m: Distance between the two ground robots, along the world's line for this sight condition.
        protocol: `ros1` (TCP) or `ros1-udp`.
        changes: Changes that apply to all rows.
    """
    master = {
        "topology": "master",
        "relay": "iris",
        "agents.husky-2.along": f"{distance_m}m",
        "agents.iris.along": f"{distance_m / 2}m",
        "agents.iris.motion": {"kind": "station-keeping"},
    }
    return Setup(_baylands(sight, master | _bag("husky-1", "husky-2", protocol), changes), SlidingWindow.name)


def mesh(radio: Changes, changes: Changes) -> Setup:
    """Return the setup of the experiment with EMANE. Its policy is exact, because an emulator has no sync policy.

    Args:
        radio: One of `RADIOS`.
        changes: Further changes.
    """
    return Setup(load_scenario("ten_node_mesh", {**radio, **changes}), EventDriven.name)


def only_flow(setup: Setup) -> str:
    """Return the name of the only flow of a setup."""
    (traffic,) = setup.scenario.traffic
    (flow,) = traffic.flows
    return flow


def _bag(source: str, destination: str, protocol: str) -> dict[str, Any]:
    return {"traffic": [{"kind": "bag", "from": source, "to": destination, "protocol": protocol, "start": "500ms"}]}


def _baylands(sight: Sight, row_changes: Changes, changes: Changes) -> CosimScenario:
    return load_scenario("baylands", {"line": str(sight), "duration": _DURATION, **row_changes, **changes})

"""What becomes of the traffic of many setups with many seeds: sums small enough to come from other processes."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sim_backends.cosim.columns import round_trips_s
from sim_backends.cosim.run import Fate, Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.traffic import PingTraffic
from sim_backends.cosim.studies.seeds import Task, run_many

UNDER_WAY = "under way when the run ended"


@dataclass(frozen=True)
class Setup:
    """A scenario and the policy that it is run with.

    Attributes:
        scenario: The scenario.
        policy: Name of the sync policy.
    """

    scenario: CosimScenario
    policy: str


@dataclass(frozen=True)
class FlowSample:
    """What became of a flow in one run; of a ping, of its requests.

    Attributes:
        sent: Packets.
        arrived: Those of them that arrived, or were answered, before the run ended.
        delay_sum_s: Sum of their delays, from sending to arrival as the receiver counts it, or of round trips; nan of
            none, which is no fast transmission.
        reasons: Why how many of the others did not.
    """

    sent: int
    arrived: int
    delay_sum_s: float
    reasons: Mapping[str, int]

    @property
    def loss(self) -> float:
        """Share of the packets that did not arrive; nan of none."""
        return 1 - self.arrived / self.sent if self.sent else np.nan

    @property
    def delay_mean_s(self) -> float:
        """Mean delay of those that arrived; nan of none."""
        return self.delay_sum_s / self.arrived if self.arrived else np.nan


def flow_samples(
    setups: Mapping[str, Setup],
    seeds: Sequence[int],
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, list[dict[str, FlowSample]]]:
    """Return for each setup, and for each seed in their order, what became of each flow.

    Args:
        setups: What is run, by a name.
        seeds: Of random draws.
        workers: As of `run_many`.
        progress: As of `run_many`.

    Raises:
        FieldkitError: A run failed.
    """
    tasks = [Task(setup.policy, seed, name) for name, setup in setups.items() for seed in seeds]
    samples = run_many(partial(_sample, dict(setups)), tasks, workers=workers, progress=progress)
    found: dict[str, list[dict[str, FlowSample]]] = {name: [] for name in setups}
    for task, sample in zip(tasks, samples, strict=True):
        found[task.setup].append(sample)
    return found


def _sample(setups: Mapping[str, Setup], task: Task) -> dict[str, FlowSample]:
    scenario = setups[task.setup].scenario
    run = build(scenario, policy=task.policy, seed=task.seed).run()
    return {
        flow: _round_trips(run, flow) if isinstance(one, PingTraffic) else _deliveries(run, flow)
        for one in scenario.traffic
        for flow in one.flows
    }


def _deliveries(run: Run, flow: str) -> FlowSample:
    fates = _fates(run, flow)
    delays_ns = [fate.counted_ns - fate.packet.sent_ns for fate in fates if fate.counted_ns is not None]
    return _flow_sample(len(fates), [delay_ns / 1e9 for delay_ns in delays_ns], fates)


def _round_trips(run: Run, flow: str) -> FlowSample:
    trips_s = round_trips_s(run, flow)
    answered_s = trips_s[np.isfinite(trips_s)]
    return _flow_sample(len(trips_s), answered_s.tolist(), _fates(run, flow))


def _fates(run: Run, flow: str) -> list[Fate]:
    return [fate for (name, _), fate in run.fates.items() if name == flow]


def _flow_sample(sent: int, delays_s: Sequence[float], fates: Sequence[Fate]) -> FlowSample:
    reasons = Counter(fate.reason or UNDER_WAY for fate in fates if fate.arrived_ns is None)
    return FlowSample(sent, len(delays_s), sum(delays_s) if delays_s else np.nan, dict(reasons))

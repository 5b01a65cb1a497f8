"""Computes the results of a run: flows, recoveries after faults, and position errors of followers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Topology, Vector
from sim_backends.cosim.commands.sheets import SheetColumn, Value
from sim_backends.cosim.programs.senders import REPLY
from sim_backends.cosim.real_time import WindowLateness
from sim_backends.cosim.run_record import Fate, Run
from sim_backends.cosim.scenario.faults import Fault, JammerFault, LinkCutFault, NodeLossFault, StalledFederateFault
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import Formation, compute_formation, tracks_of
from sim_backends.world.motion import State


@dataclass(frozen=True)
class FlowRecovery:
    """The recovery of a flow after a fault.

    Attributes:
        fault: Index of the fault in the scenario, from 0.
        flow: Name of the flow.
        end_ns: Time when the fault ended.
        lost_packets: Number of packets that were sent during the fault and never arrived.
        recovered_s: Time from `end_ns` to the first arrival of a packet that was sent after it; None without one.
    """

    fault: int
    flow: str
    end_ns: int
    lost_packets: int
    recovered_s: float | None


def recoveries(scenario: CosimScenario, run: Run) -> list[FlowRecovery]:
    """Return the recovery of each flow from each fault of the radio that affected it.

    A fault that has no end, or that ends after the run, is ignored.

    Args:
        scenario: The scenario with the faults.
        run: A run of the scenario.
    """
    end_of_run_ns = run.windows_ns[-1] if run.windows_ns else 0
    all_recoveries = []
    for number, fault in enumerate(scenario.faults):
        end_ns = None if isinstance(fault, StalledFederateFault) else fault.end_ns
        if end_ns is None or end_ns > end_of_run_ns:
            continue
        flows = (flow_ends for traffic in scenario.traffic for flow_ends in traffic.flow_ends)
        for flow in sorted(flow for flow, *ends in flows if _affects(fault, set(ends), scenario)):
            fates = [fate for (name, _), fate in run.fates.items() if name == flow]
            counted_ns = [
                fate.counted_ns for fate in fates if fate.packet.sent_ns >= end_ns and fate.counted_ns is not None
            ]
            lost_packets = sum(fault.begin_ns <= fate.packet.sent_ns < end_ns and bool(fate.reason) for fate in fates)
            recovered_s = (min(counted_ns) - end_ns) / 1e9 if counted_ns else None
            all_recoveries.append(FlowRecovery(number, flow, end_ns, lost_packets, recovered_s))
    return all_recoveries


def _affects(fault: Fault, ends: set[str], scenario: CosimScenario) -> bool:
    """Return True if a fault can affect the path between two agents; a jammer can affect every path."""
    relay = scenario.relay if scenario.topology is Topology.MASTER else None
    hops = [ends] if relay is None or relay in ends else [{end, relay} for end in ends]
    match fault:
        case JammerFault():
            return True
        case NodeLossFault():
            return any(fault.agent in hop for hop in hops)
        case LinkCutFault():
            return set(fault.between) in hops
    return False


Floats = NDArray[np.float64]

_JITTER_GAIN = 1 / 16
"""Gain of the estimator of jitter (RFC 3550, section 6.4.1)."""


@dataclass(frozen=True)
class FlowSpread:
    """Statistics of durations in seconds, such as the delays of the packets that arrived; nan without values.

    Attributes:
        minimum: The minimum.
        mean: The mean.
        median: The median.
        p95: The 95th percentile.
        maximum: The maximum.
    """

    minimum: float
    mean: float
    median: float
    p95: float
    maximum: float


@dataclass(frozen=True)
class FlowRoundTrips:
    """The round trips of a ping; requests that may still get a reply are ignored.

    Attributes:
        request_count: Number of requests.
        reply_count: Number of requests whose reply arrived.
        network_s: Time that request and reply together spent in the network.
        jitter_s: Mean absolute difference of successive round trips; nan if there are fewer than two.
        times: For each answered request, in order: its number from 0, the simulated time of the reply's arrival in
            nanoseconds, and the time in the network in seconds.
    """

    request_count: int
    reply_count: int
    network_s: FlowSpread
    jitter_s: float
    times: tuple[tuple[int, int, float], ...] = ()


@dataclass(frozen=True)
class FlowResult:
    """The results of a flow.

    Packets that were under way at the end of the run count only in `packets_under_way`, the distances and the speeds.

    Attributes:
        name: The flow.
        source: The sending agent.
        destination: The receiving agent.
        protocol: Its transport.
        sent_packets: Number of packets whose fate is decided.
        arrived_packets: Number of these packets that arrived.
        packets_under_way: Number of packets whose fate is not decided.
        sent_bytes: Total size of sent packets.
        arrived_bytes: Total size of packets that arrived.
        delay_s: Time in the network of the packets that arrived.
        first_to_last_s: Time from the first arrival to the last; nan without arrivals.
        jitter_s: Interarrival jitter after the last packet (RFC 3550, section 6.4.1); nan for fewer than two packets.
        added_s: Mean delay that the sync policy added, before and after the network.
        distances_m: Distance between sender and receiver: at the first packet, then minimum, mean and maximum over
            all packets.
        sender_m_s: Mean speed of the sender at the times of sending.
        relative_m_s: Mean magnitude of the sender's velocity relative to the receiver.
        round_trips: The round trips of a ping; None for other flows.
        last_arrived_ns: Simulated time of the last arrival; None without arrivals.
    """

    name: str
    source: str
    destination: str
    protocol: str
    sent_packets: int
    arrived_packets: int
    packets_under_way: int
    sent_bytes: int
    arrived_bytes: int
    delay_s: FlowSpread
    first_to_last_s: float
    jitter_s: float
    added_s: float
    distances_m: tuple[float, float, float, float]
    sender_m_s: float
    relative_m_s: float
    round_trips: FlowRoundTrips | None
    last_arrived_ns: int | None = None

    @property
    def loss(self) -> float:
        """Share of `sent_packets` that never arrived; nan without such packets."""
        return 1 - self.arrived_packets / self.sent_packets if self.sent_packets else np.nan


def flow_results(run: Run) -> tuple[FlowResult, ...]:
    """Return the results of each flow that sent a packet, in the order of their names."""
    flows: dict[str, list[Fate]] = {}
    for fate in run.fates.values():
        flows.setdefault(fate.packet.identity[0], []).append(fate)
    return tuple(_result(name, flows[name], flows.get(name + REPLY)) for name in sorted(flows))


def _result(name: str, fates: Sequence[Fate], replies: Sequence[Fate] | None) -> FlowResult:
    """Return the results of a flow from the fates of its packets; `replies` is None if the flow is not a ping."""
    packet = fates[0].packet
    decided_fates = [fate for fate in fates if fate.is_decided]
    times = [
        (fate.packet.sent_ns, fate.packet.enters_ns, fate.arrived_ns, fate.counted_ns)
        for fate in decided_fates
        if fate.arrived_ns is not None and fate.counted_ns is not None
    ]
    arrived_fates = [fate for fate in decided_fates if fate.arrived_ns is not None]
    sent_ns, enters_ns, arrived_ns, counted_ns = np.array(times, np.int64).reshape(-1, 4).T
    delay_s = (arrived_ns - enters_ns) / 1e9
    distances_m = _distances(
        [fate.true_states[0].position_m for fate in fates], [fate.true_states[1].position_m for fate in fates]
    )
    velocities = (
        [fate.true_states[0].velocity_m_s for fate in fates],
        [fate.true_states[1].velocity_m_s for fate in fates],
    )
    return FlowResult(
        name=name,
        source=packet.source,
        destination=packet.destination,
        protocol=packet.protocol,
        sent_packets=len(decided_fates),
        arrived_packets=len(arrived_fates),
        packets_under_way=len(fates) - len(decided_fates),
        sent_bytes=sum(fate.packet.size_bytes for fate in decided_fates),
        arrived_bytes=sum(fate.packet.size_bytes for fate in arrived_fates),
        delay_s=_spread(delay_s),
        first_to_last_s=float(np.ptp(arrived_ns)) / 1e9 if len(arrived_ns) else np.nan,
        jitter_s=_jitter_s(delay_s[np.argsort(arrived_ns, kind="stable")]),
        added_s=_mean(enters_ns - sent_ns + counted_ns - arrived_ns) / 1e9,
        distances_m=(
            float(distances_m[0]),
            float(distances_m.min()),
            float(distances_m.mean()),
            float(distances_m.max()),
        ),
        sender_m_s=_mean(np.linalg.norm(velocities[0], axis=1)),
        relative_m_s=_mean(_distances(*velocities)),
        round_trips=None if replies is None else _round_trips(fates, replies),
        last_arrived_ns=int(arrived_ns.max()) if len(arrived_ns) else None,
    )


def _round_trips(requests: Sequence[Fate], replies: Sequence[Fate]) -> FlowRoundTrips:
    """Return the round trips of a ping from the fates of its requests and replies."""
    replies_by_number = {reply.packet.identity[1]: reply for reply in replies}
    request_count = 0
    times: list[tuple[int, int, float]] = []
    for request in sorted(requests, key=lambda fate: fate.packet.identity[1]):
        reply = replies_by_number.get(request.packet.identity[1])
        reply_s = None if reply is None else _network_s(reply)
        request_s = _network_s(request)
        if reply is not None and reply.arrived_ns is not None and request_s is not None and reply_s is not None:
            times.append((request.packet.identity[1], reply.arrived_ns, request_s + reply_s))
        request_count += bool(request.reason) or (reply is not None and reply.is_decided)
    trips_s = [trip_s for _, _, trip_s in times]
    jitter_s = float(np.abs(np.diff(trips_s)).mean()) if len(trips_s) > 1 else np.nan
    return FlowRoundTrips(request_count, len(trips_s), _spread(np.array(trips_s)), jitter_s, tuple(times))


def _network_s(fate: Fate) -> float | None:
    """Return the time that a packet spent in the network; None if it did not arrive."""
    return None if fate.arrived_ns is None else (fate.arrived_ns - fate.packet.enters_ns) / 1e9


def _distances(first: Sequence[Vector], second: Sequence[Vector]) -> Floats:
    return np.asarray(np.linalg.norm(np.subtract(first, second), axis=1), np.float64)


def _spread(values: Floats) -> FlowSpread:
    if not len(values):
        return FlowSpread(*(np.nan,) * 5)
    p50, p95 = np.quantile(values, [0.5, 0.95])
    return FlowSpread(float(values.min()), float(values.mean()), float(p50), float(p95), float(values.max()))


def _mean(values: NDArray[np.float64] | NDArray[np.int64]) -> float:
    return float(values.mean()) if len(values) else np.nan


def _jitter_s(delays_s: Floats) -> float:
    """Return the jitter of packets from their delays, in the order of arrival."""
    changes_s = np.abs(np.diff(delays_s))
    # The recursion J += (|D| - J) / 16 from J = 0, as a weighted sum.
    weights = _JITTER_GAIN * (1 - _JITTER_GAIN) ** np.arange(len(changes_s))[::-1]
    return float(weights @ changes_s) if len(changes_s) else np.nan


FORMATION: Final = (
    SheetColumn("spacing_mean_m", "spacing (cm)", "mean absolute error of the distance behind a leader", 1e2),
    SheetColumn("spacing_max_m", "max", "its maximum", 1e2),
    SheetColumn("station_mean_m", "station (cm)", "mean distance of a drone from its station above its leaders", 1e2),
    SheetColumn("station_max_m", "max", "its maximum", 1e2),
    SheetColumn(
        "amplification",
        "amplified",
        "largest ratio of a follower's acceleration to its leader's; up to 1 if disturbances do not grow in the row",
    ),
)
"""Columns of a `Formation`, in the order of `formation_values`."""


def formation_values(formation: Formation) -> tuple[Value, ...]:
    """Return the values of the columns `FORMATION`."""
    return (
        formation.spacing_mean_m,
        formation.spacing_max_m,
        formation.station_mean_m,
        formation.station_max_m,
        formation.amplification,
    )


@dataclass(frozen=True)
class SeedResult:
    """The result of a run.

    Attributes:
        seed: The seed of the run.
        flows: The results of its flows.
        simulated_s: Simulated time in seconds.
        windows: Number of windows.
        wall_s: Wall time in seconds, by part.
        digest: Hash over all events.
        starts_m: Position of each agent at its start, metres east, north, up.
        recoveries: Recoveries of flows after faults.
        formation: Errors of the positions of followers.
        stop_reason: The reason why the run ended early; empty if the run is complete.
        error: The error that ended the run early; None if the run is complete or was interrupted.
        lateness: Lateness of the run's windows; None if it was not a run in real time.
    """

    seed: int
    flows: Sequence[FlowResult]
    simulated_s: float
    windows: int
    wall_s: Mapping[str, float]
    digest: str
    starts_m: Mapping[str, Vector]
    recoveries: Sequence[FlowRecovery]
    formation: Formation
    stop_reason: str = ""
    error: FieldkitError | None = None
    lateness: WindowLateness | None = None

    @property
    def is_interrupted(self) -> bool:
        """True if Ctrl-C ended the run."""
        return bool(self.stop_reason) and self.error is None


def seed_result(
    scenario: CosimScenario,
    seed: int,
    run: Run,
    states: Sequence[tuple[int, str, State]],
    *,
    ended_by: FieldkitError | KeyboardInterrupt | None = None,
    starts: Mapping[str, State] | None = None,
    lateness: WindowLateness | None = None,
) -> SeedResult:
    """Return the result of a run.

    Args:
        scenario: The scenario.
        seed: The seed of the run.
        run: The record of the run.
        states: States of agents in the form of `Recording.states`; empty without a recording if no agent is a
            follower.
        ended_by: The exception that ended the run early, or None.
        starts: States of all agents at their starts; if None, the first state of each agent in `states` is used.
        lateness: Lateness of the run's windows; None if it was not a run in real time.
    """
    ended_s = run.windows_ns[-1] / 1e9 if run.windows_ns else 0.0
    error = ended_by if isinstance(ended_by, FieldkitError) else None
    stop_reason = ""
    if error is not None:
        stop_reason = error.located
    elif ended_by is not None:
        stop_reason = f"interrupted at {ended_s:g} s"
    return SeedResult(
        seed=seed,
        flows=flow_results(run),
        simulated_s=ended_s,
        windows=len(run.windows_ns),
        wall_s=dict(run.wall_s),
        digest=run.digest,
        starts_m={agent: state.position_m for _, agent, state in reversed(states)}
        | {agent: state.position_m for agent, state in (starts or {}).items()},
        recoveries=recoveries(scenario, run),
        formation=compute_formation(scenario, tracks_of(states)),
        stop_reason=stop_reason,
        error=error,
        lateness=lateness,
    )

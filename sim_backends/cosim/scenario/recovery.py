"""The time that traffic takes to recover after a fault."""

from dataclasses import dataclass

from fieldkit.core.model import Topology
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.faults import Fault, JammerFault, LinkCutFault, NodeLossFault, StalledFederateFault
from sim_backends.cosim.scenario.schema import CosimScenario


@dataclass(frozen=True)
class FlowRecovery:
    """The recovery of a flow after a fault.

    Attributes:
        fault: Index of the fault in the scenario, from 0.
        flow: Name of the flow.
        end_ns: Time when the fault ended.
        lost: Number of packets that were sent during the fault and never arrived.
        recovered_s: Time from then to the first arrival of a packet that was sent after it; None if there was none.
    """

    fault: int
    flow: str
    end_ns: int
    lost: int
    recovered_s: float | None


def recoveries(scenario: CosimScenario, run: Run) -> list[FlowRecovery]:
    """Return the recovery of each flow that a fault of the radio affected, by fault and flow.

    A fault without an end, or whose end the run did not reach, is ignored.

    Args:
        scenario: The scenario with the faults.
        run: A run of it.
    """
    reached_ns = run.windows_ns[-1] if run.windows_ns else 0
    all_recoveries = []
    for number, fault in enumerate(scenario.faults):
        end_ns = None if isinstance(fault, StalledFederateFault) else fault.end_ns
        if end_ns is None or end_ns > reached_ns:
            continue
        flows = (flow_ends for traffic in scenario.traffic for flow_ends in traffic.flow_ends)
        for flow in sorted(flow for flow, *ends in flows if _affects(fault, set(ends), scenario)):
            fates = [fate for (name, _), fate in run.fates.items() if name == flow]
            counted_ns = [
                fate.counted_ns for fate in fates if fate.packet.sent_ns >= end_ns and fate.counted_ns is not None
            ]
            lost = sum(fault.begin_ns <= fate.packet.sent_ns < end_ns and bool(fate.reason) for fate in fates)
            recovered_s = (min(counted_ns) - end_ns) / 1e9 if counted_ns else None
            all_recoveries.append(FlowRecovery(number, flow, end_ns, lost, recovered_s))
    return all_recoveries


def _affects(fault: Fault, ends: set[str], scenario: CosimScenario) -> bool:
    """Return True if a fault is on the path between two ends."""
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

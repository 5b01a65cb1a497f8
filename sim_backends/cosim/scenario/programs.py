"""The programs of a scenario's agents: traffic, controllers, and faults of their computers."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from sim_backends.cosim.federates import Program
from sim_backends.cosim.programs.bags import Playback, pieces, recorded
from sim_backends.cosim.programs.clocks import AgentClock, Clocked
from sim_backends.cosim.programs.outages import Outage
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.programs.pings import EchoRequester, EchoResponder
from sim_backends.cosim.programs.several import CombinedProgram
from sim_backends.cosim.scenario.faults import ClockSkewFault, NodeLossFault
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.traffic import BagTraffic, FileTraffic, PingTraffic, StreamTraffic, Traffic
from sim_backends.radio.random_streams import RandomStream

ONCE_WITHIN_S: Final = 0.1
"""Traffic without a period begins at a random time in this interval: the longest usual window (`policy.longest`)."""


def programs(
    scenario: CosimScenario, seed: int, controllers: Mapping[str, Program], stops: Mapping[str, Any]
) -> dict[str, Program]:
    """Return the program of each agent; an agent without traffic and controller has none.

    Args:
        scenario: The scenario.
        seed: Seed of the random draws.
        controllers: The program that steers each agent.
        stops: The command that stops each agent's body.
    """
    parts: dict[str, list[Program]] = {name: [] for name in scenario.agents}
    for name, controller in controllers.items():
        parts[name].append(controller)
    for traffic in scenario.traffic:
        parts[traffic.source] += [_sender(traffic, flow, to, seed) for flow, to in traffic.flows.items()]
    for name in {to for traffic in scenario.traffic if isinstance(traffic, PingTraffic) for to in traffic.to}:
        parts[name].append(EchoResponder())
    combined: dict[str, Program] = {
        name: of_agent[0] if len(of_agent) == 1 else CombinedProgram(of_agent)
        for name, of_agent in parts.items()
        if of_agent
    }
    return dict(_with_faults(scenario, combined, stops))


def _sender(traffic: Traffic, flow: str, to: str, seed: int) -> Program:
    phase = RandomStream(seed, flow, "phase").draw(0)
    begin_ns = _ns(traffic.start + phase * (traffic.period_s or ONCE_WITHIN_S))
    match traffic:
        case StreamTraffic():
            return Periodic(
                flow,
                to,
                period_ns=_ns(1 / traffic.rate),
                size_bytes=traffic.size_bytes,
                first_ns=begin_ns,
                stop_ns=None if traffic.stop is None else _ns(traffic.stop),
                protocol=traffic.transport,
            )
        case PingTraffic():
            return EchoRequester(
                flow,
                to,
                count=traffic.count,
                interval_ns=_ns(traffic.interval),
                size_bytes=traffic.size_bytes,
                first_ns=begin_ns,
                protocol=traffic.transport,
            )
        case FileTraffic():
            bag = pieces(traffic.size_bytes, traffic.piece_bytes)
        case BagTraffic():
            bag = recorded(
                # The stream depends on the bag only, because every receiver gets the same bag.
                RandomStream(seed, traffic.title, "recorded"),
                length_ns=_ns(traffic.length),
                rate_hz=traffic.rate,
                size_bytes=traffic.size_bytes,
                jitter_ns=_ns(traffic.jitter),
            )
    return Playback(flow, to, bag, begin_ns=begin_ns, protocol=traffic.transport)


def _with_faults(
    scenario: CosimScenario, combined: Mapping[str, Program], stops: Mapping[str, Any]
) -> Iterator[tuple[str, Program]]:
    skews = [fault for fault in scenario.faults if isinstance(fault, ClockSkewFault)]
    clocks = {
        skew.agent: AgentClock(skew.begin_ns, skew.end_ns, round(skew.offset_ms * 1e6), round(skew.rate_ppm * 1e3))
        for skew in skews
    }
    for name, program in combined.items():
        wrapped = Clocked(program, clocks.get(name, AgentClock())) if skews else program
        for fault in scenario.faults:
            if isinstance(fault, NodeLossFault) and fault.agent == name:
                wrapped = Outage(wrapped, fault.begin_ns, fault.end_ns, stops.get(name))
        yield name, wrapped


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)

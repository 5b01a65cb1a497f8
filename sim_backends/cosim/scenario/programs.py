"""The programs of a scenario's agents: what they send, how they steer, and what goes wrong with their computers."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from sim_backends.cosim.federates import Program
from sim_backends.cosim.programs.bags import Playback, pieces, recorded
from sim_backends.cosim.programs.clocks import AgentClock, Clocked
from sim_backends.cosim.programs.outages import Outage
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.programs.pings import EchoRequester, PingAnswers
from sim_backends.cosim.programs.several import Several
from sim_backends.cosim.scenario.faults import ClockSkewFault, NodeLossFault
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.traffic import BagTraffic, FileTraffic, PingTraffic, StreamTraffic, Traffic
from sim_backends.radio.random_streams import RandomStream

ONCE_WITHIN_S: Final = 0.1
"""Within which time what has no period begins: as long as the longest usual window (`policy.longest`)."""


def programs(
    scenario: CosimScenario, seed: int, controllers: Mapping[str, Program], stops: Mapping[str, Any]
) -> dict[str, Program]:
    """Return what runs on each agent.

    Args:
        scenario: The scenario.
        seed: Of the random draws.
        controllers: What steers, by agent.
        stops: The command that stops each agent's body.
    """
    found: dict[str, list[Program]] = {name: [] for name in scenario.agents}
    for name, controller in controllers.items():
        found[name].append(controller)
    for one in scenario.traffic:
        found[one.source] += [_sender(one, flow, to, seed) for flow, to in one.flows.items()]
    for name in {to for one in scenario.traffic if isinstance(one, PingTraffic) for to in one.to}:
        found[name].append(PingAnswers())
    running: dict[str, Program] = {
        name: some[0] if len(some) == 1 else Several(some) for name, some in found.items() if some
    }
    return dict(_with_faults(scenario, running, stops))


def _sender(one: Traffic, flow: str, to: str, seed: int) -> Program:
    begin_ns = _ns(one.start + RandomStream(seed, flow, "phase").draw(0) * (one.period_s or ONCE_WITHIN_S))
    match one:
        case StreamTraffic():
            return Periodic(
                flow,
                to,
                period_ns=_ns(1 / one.rate),
                size_bytes=one.size_bytes,
                first_ns=begin_ns,
                stop_ns=None if one.stop is None else _ns(one.stop),
                protocol=one.transport,
            )
        case PingTraffic():
            return EchoRequester(
                flow,
                to,
                count=one.count,
                interval_ns=_ns(one.interval),
                size_bytes=one.size_bytes,
                first_ns=begin_ns,
                protocol=one.transport,
            )
        case FileTraffic():
            bag = pieces(one.size_bytes, one.piece_bytes)
        case BagTraffic():
            bag = recorded(
                # Of the bag, which every receiver gets.
                RandomStream(seed, one.title, "recorded"),
                length_ns=_ns(one.length),
                rate_hz=one.rate,
                size_bytes=one.size_bytes,
                jitter_ns=_ns(one.jitter),
            )
    return Playback(flow, to, bag, begin_ns=begin_ns, protocol=one.transport)


def _with_faults(
    scenario: CosimScenario, running: Mapping[str, Program], stops: Mapping[str, Any]
) -> Iterator[tuple[str, Program]]:
    skewed = [one for one in scenario.faults if isinstance(one, ClockSkewFault)]
    clocks = {
        one.agent: AgentClock(one.begin_ns, one.end_ns, round(one.offset_ms * 1e6), round(one.rate_ppm * 1e3))
        for one in skewed
    }
    for name, program in running.items():
        guarded = Clocked(program, clocks.get(name, AgentClock())) if skewed else program
        for fault in scenario.faults:
            if isinstance(fault, NodeLossFault) and fault.agent == name:
                guarded = Outage(guarded, fault.begin_ns, fault.end_ns, stops.get(name))
        yield name, guarded


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)

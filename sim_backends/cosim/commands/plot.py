"""`fieldkit cosim plot`: a recording as a figure, or the table of a shootout."""

import argparse
import math

from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.replay import recording_at, title
from sim_backends.cosim.plots import FlowTrace, run_figure
from sim_backends.cosim.recording.replay import Recording


def run(arguments: argparse.Namespace) -> int:
    """Draw it."""
    draw = settings.figure(arguments.out, "--out")
    recording = recording_at(arguments.recording)
    draw(lambda form: run_figure(title(recording), _ways_m(recording), _traces(recording), form))
    return 0


def _ways_m(recording: Recording) -> dict[str, list[tuple[float, float]]]:
    ways_m: dict[str, list[tuple[float, float]]] = {}
    for _, agent, state in recording.states:
        ways_m.setdefault(agent, []).append(state.position_m[:2])
    return ways_m


def _traces(recording: Recording) -> list[FlowTrace]:
    flows: dict[str, list[tuple[float, float, float]]] = {}
    for fate in recording.run.fates.values():
        if fate.is_known:
            arrived_ns = fate.arrived_ns
            delay_s = math.nan if arrived_ns is None else (arrived_ns - fate.packet.enters_ns) / 1e9
            apart_m = math.dist(fate.true[0].position_m, fate.true[1].position_m)
            flows.setdefault(fate.packet.identity[0], []).append((fate.packet.sent_ns / 1e9, delay_s, apart_m))
    return [FlowTrace(name, *zip(*sorted(flows[name]), strict=True)) for name in sorted(flows)]

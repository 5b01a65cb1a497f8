"""`fieldkit cosim plot`: a recording as a figure, or the table of a shootout."""

import argparse
import csv
import math
from dataclasses import fields
from pathlib import Path
from typing import Final

from fieldkit.cli.display import show_note
from fieldkit.core.errors import ConfigurationError, EvidenceError
from sim_backends.cosim.commands import figures, settings
from sim_backends.cosim.commands.figures import CostPoint
from sim_backends.cosim.commands.replay import recording_at, scenario_of, title
from sim_backends.cosim.from_above import ObstacleOutline, outlines
from sim_backends.cosim.plots import FlowTrace, run_figure
from sim_backends.cosim.recording.replay import Recording
from sim_backends.world.world import load_world

_TABLE: Final = "write one with fieldkit cosim shootout SCENARIO --format csv > shootout.csv"


def run(arguments: argparse.Namespace) -> int:
    """Draw it."""
    draw = settings.figure(arguments.out, "--out")
    if arguments.recording.suffix == ".csv":
        draw(figures.error_against_cost(_points(arguments.recording)))
        return 0
    recording = recording_at(arguments.recording)
    around = _around(recording)
    draw(lambda form: run_figure(title(recording), _ways_m(recording), _traces(recording), form, around))
    return 0


def _points(path: Path) -> list[CostPoint]:
    """Return the points of a table of `fieldkit cosim shootout --format csv`; rows without numbers have none.

    Raises:
        EvidenceError: It is none, or has no row with numbers.
    """
    names = [one.name for one in fields(CostPoint)][1:]
    try:
        with path.open(encoding="utf-8", newline="") as file:
            found = [
                CostPoint(row["policy"], *(float(row[name] or math.nan) for name in names))
                for row in csv.DictReader(file)
            ]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise EvidenceError(
            f"this is no table of a shootout: {type(error).__name__}: {error}", where=str(path), remedy=_TABLE
        ) from error
    found = [point for point in found if point.exchanges_per_s > 0]
    if not found:
        raise EvidenceError("no policy has numbers in this table", where=str(path), remedy=_TABLE)
    return found


def _around(recording: Recording) -> list[ObstacleOutline]:
    """Return what stands in the world of a run; nothing, with a note, where that world is not here any more."""
    name = scenario_of(recording).world
    try:
        return list(outlines(load_world(name)))
    except ConfigurationError as error:
        show_note(f"without its obstacles: {error.located}")
        return []


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

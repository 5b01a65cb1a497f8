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

_REMEDY: Final = "write one with fieldkit cosim shootout SCENARIO --format csv > shootout.csv"


def run(arguments: argparse.Namespace) -> int:
    """Draw a recording, or the table of a shootout."""
    draw = settings.figure(arguments.out, "--out")
    if arguments.recording.suffix == ".csv":
        draw(figures.error_against_cost(_points(arguments.recording)))
        return 0
    recording = recording_at(arguments.recording)
    obstacles = _obstacles(recording)
    draw(lambda form: run_figure(title(recording), _paths_m(recording), _traces(recording), form, obstacles))
    return 0


def _points(path: Path) -> list[CostPoint]:
    """Return the points of a table of `fieldkit cosim shootout --format csv`; rows without numbers are ignored.

    Raises:
        EvidenceError: The file is not such a table, or has no row with numbers.
    """
    names = [field.name for field in fields(CostPoint)][1:]
    try:
        with path.open(encoding="utf-8", newline="") as file:
            points = [
                CostPoint(row["policy"], *(float(row[name] or math.nan) for name in names))
                for row in csv.DictReader(file)
            ]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise EvidenceError(
            f"this is not the table of a shootout: {type(error).__name__}: {error}", where=str(path), remedy=_REMEDY
        ) from error
    points = [point for point in points if point.exchanges_per_s > 0]
    if not points:
        raise EvidenceError("no policy has numbers in this table", where=str(path), remedy=_REMEDY)
    return points


def _obstacles(recording: Recording) -> list[ObstacleOutline]:
    """Return the outlines of the obstacles in the world of a run; none, with a note, if that world does not exist."""
    name = scenario_of(recording).world
    try:
        return list(outlines(load_world(name)))
    except ConfigurationError as error:
        show_note(f"drawn without obstacles: {error.located}")
        return []


def _paths_m(recording: Recording) -> dict[str, list[tuple[float, float]]]:
    paths_m: dict[str, list[tuple[float, float]]] = {}
    for _, agent, state in recording.states:
        paths_m.setdefault(agent, []).append(state.position_m[:2])
    return paths_m


def _traces(recording: Recording) -> list[FlowTrace]:
    flows: dict[str, list[tuple[float, float, float]]] = {}
    for fate in recording.run.fates.values():
        if fate.is_decided:
            arrived_ns = fate.arrived_ns
            delay_s = math.nan if arrived_ns is None else (arrived_ns - fate.packet.enters_ns) / 1e9
            distance_m = math.dist(fate.true[0].position_m, fate.true[1].position_m)
            flows.setdefault(fate.packet.identity[0], []).append((fate.packet.sent_ns / 1e9, delay_s, distance_m))
    return [FlowTrace(name, *zip(*sorted(flows[name]), strict=True)) for name in sorted(flows)]

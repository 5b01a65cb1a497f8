"""`fieldkit positions TRIAL [ROLE=FILE ...]`: measured positions of robots, from files or coordinates."""

import argparse
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.text import print_text
from fieldkit.core.units import parse_duration_s

if TYPE_CHECKING:
    from fieldkit.trial.stored.positions import AttemptPositions


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit positions`."""
    parser.description = (
        "Store files with measured positions of robots in a trial, and fill the distance and speed columns "
        "from them. Without files, list the source of the positions in each repeat."
    )
    parser.epilog = "example: fieldkit positions trials/... receiver=walk.gpx sender=48.13740,11.57550 --offset 0.3s"
    parser.takes_lengths = True
    shared.add_trial(parser)
    parser.add_argument(
        "files",
        metavar="ROLE=FILE",
        nargs="*",
        help="GPX or CSV file of the robot in that role, or its position: LAT,LON[,ALT], or X,Y[,Z] with units",
    )
    parser.add_argument(
        "--offset",
        metavar="TIME",
        default="0s",
        help="time to add to the times of the files: 0.3s, -2s (default: 0s)",
    )
    parser.add_argument(
        "--gap",
        metavar="TIME",
        default="3s",
        help="if two positions are farther apart in time, positions between them are unknown (default: 3s)",
    )
    parser.add_argument("--heights", action="store_true", help="also use heights above the ellipsoid")
    parser.add_argument("--clear", action="store_true", help="remove the stored files")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Store the given files, and print the distances in each repeat with their source."""
    from fieldkit.trial.stored import positions

    files = dict(map(positions.parse_source, arguments.files))
    if files or arguments.clear:
        if files and arguments.clear:
            raise ConfigurationError(
                "--clear removes the stored files and cannot be combined with new ones",
                remedy="omit it to replace the stored files",
            )
        rebuilt = positions.set_positions(
            arguments.trial,
            files,
            offset_s=_offset_s(arguments.offset),
            gap_s=parse_duration_s(arguments.gap, "--gap"),
            heights=arguments.heights,
        )
        print_text(f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before")
    for attempt_positions in positions.attempt_positions(arguments.trial):
        for line in _lines(attempt_positions):
            print_text(line)
    return 0


def _offset_s(text: str) -> float:
    text = text.strip()
    offset_s = parse_duration_s(text.removeprefix("-"), "--offset")
    return -offset_s if text.startswith("-") else offset_s


def _lines(attempt_positions: "AttemptPositions") -> list[str]:
    """Return the lines about an attempt, one per distance."""
    source = attempt_positions.source or "positions from the backend"
    lines = [
        f"{attempt_positions.attempt}  {pair}: {minimum_m:.1f} to {maximum_m:.1f} m, {source}"
        for pair, (minimum_m, maximum_m) in attempt_positions.distances_m.items()
    ]
    return lines + [
        f"{attempt_positions.attempt}  {pair}: no distance, {reason}"
        for pair, reason in attempt_positions.missing.items()
    ]

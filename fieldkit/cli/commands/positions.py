"""`fieldkit positions TRIAL [ROLE=FILE ...]`: where robots really stood, from who walked with them."""

import argparse
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.printing import say
from fieldkit.core.units import parse_duration_s

if TYPE_CHECKING:
    from fieldkit.trial.positions import Spotted


def add(parser: Parser) -> None:
    """Declare what `fieldkit positions` takes."""
    parser.description = (
        "Keep files that tell where robots were with a trial, and fill the distance and speed columns "
        "from them; without any, list who tells it in each repeat."
    )
    parser.epilog = "example: fieldkit positions trials/... receiver=walk.gpx sender=48.13740,11.57550 --offset 0.3s"
    parser.takes_lengths = True
    shared.add_trial(parser)
    parser.add_argument(
        "told",
        metavar="ROLE=FILE",
        nargs="*",
        help="GPX or CSV of the robot in that role, or where it stood: LAT,LON[,ALT], or X,Y[,Z] with units",
    )
    parser.add_argument(
        "--offset", metavar="TIME", default="0s", help="add it to the times of the files: 0.3s, -2s (default: 0s)"
    )
    parser.add_argument(
        "--gap", metavar="TIME", default="3s", help="nobody knows where a robot was in longer gaps (default: 3s)"
    )
    parser.add_argument("--heights", action="store_true", help="let heights over the ellipsoid count, too")
    parser.add_argument("--clear", action="store_true", help="forget what was given")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Keep what is given, and print who tells where robots were in each repeat, and how far apart."""
    from fieldkit.trial import positions

    told = dict(map(positions.told, arguments.told))
    if told or arguments.clear:
        if told and arguments.clear:
            raise ConfigurationError("--clear forgets what was given", remedy="leave it out to give others instead")
        rebuilt = positions.give(
            arguments.trial,
            told,
            offset_s=_offset_s(arguments.offset),
            gap_s=parse_duration_s(arguments.gap),
            heights=arguments.heights,
        )
        say(f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before")
    for spotted in positions.spotted(arguments.trial):
        for line in _lines(spotted):
            say(line)
    return 0


def _offset_s(text: str) -> float:
    text = text.strip()
    offset_s = parse_duration_s(text.removeprefix("-"))
    return -offset_s if text.startswith("-") else offset_s


def _lines(one: "Spotted") -> list[str]:
    """Return what is known of an attempt, a line per figure."""
    who = one.told_by or "as the lab knows"
    found = [
        f"{one.attempt}  {what}: {least:.1f} to {most:.1f} m, {who}"
        for what, (least, most) in one.distances_m.items()
    ]
    return found + [f"{one.attempt}  {what}: no distance, {why}" for what, why in one.missing.items()]

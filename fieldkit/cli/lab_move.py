"""`fieldkit lab move`: a robot of the lab goes elsewhere, at once."""

import argparse
from pathlib import Path

from fieldkit.cli.listing import Commands
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.geometry import Position
from fieldkit.core.units import parse_offset_m
from fieldkit.lab import client, folder
from fieldkit.lab.protocol import Destination

_EXAMPLE = "fieldkit lab move ROBOT --to 20m 10m, or --by 0m -30ft, and 5m for UP where it flies"


def add(actions: Commands) -> None:
    """Add the subcommand of `fieldkit lab`."""
    parser = actions.add_parser(
        "move",
        help="put a robot elsewhere, at once",
        usage="%(prog)s [-h] ROBOT (--to EAST NORTH [UP] | --by EAST NORTH [UP])",
        description="Put a robot elsewhere, at once. Lengths have units (20m, -30ft) and are its antenna's.",
    )
    parser.add_argument("robot", metavar="ROBOT", help="name of the robot")
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument(
        "--to", nargs="+", metavar="LENGTH", help="EAST NORTH [UP] in the world; on the ground without UP"
    )
    way.add_argument("--by", nargs="+", metavar="LENGTH", help="EAST NORTH [UP] from where it is, UP over the ground")
    parser.set_defaults(run=_move)


def shown(place_m: Position) -> str:
    """Return a place for people, to the centimetre: `198.5, 200, 0.2`."""
    return ", ".join(f"{round(metres, 2):.10g}" for metres in place_m)


def _move(arguments: argparse.Namespace) -> int:
    """Move the robot and say where it is."""
    relative = arguments.to is None
    option, words = ("--by", arguments.by) if relative else ("--to", arguments.to)
    if len(words) not in {2, 3}:
        raise ConfigurationError(f"{option} takes EAST NORTH [UP], not {' '.join(words)!r}", remedy=_EXAMPLE)
    east_m, north_m, *up_m = map(parse_offset_m, words)
    to = Destination(east_m, north_m, up_m[0] if up_m else None, relative)
    place_m = client.move(folder.of_directory(Path.cwd()), arguments.robot, to)
    print(f"{arguments.robot} is at {shown(place_m)} (m east, north, up)")
    return 0

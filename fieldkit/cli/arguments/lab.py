"""What `fieldkit lab` takes."""

import argparse
from pathlib import Path

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Commands, Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit lab` takes."""
    parser.description = "Emulated robots that stay up until they are taken down: one lab per directory."
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    up = actions.add_parser("up", help="bring the robots of the site file up, all in one place, or N alike")
    shared.add_robots(up)
    up.add_argument("--seed", type=int, default=1, metavar="N", help="seed of everything random (default 1)")
    up.add_argument("--foreground", action="store_true", help="keep this terminal; Ctrl-C takes the robots down")
    up.set_defaults(run="lab:up")
    listing = actions.add_parser("ps", help="list the robots: where they are, what runs on them")
    listing.set_defaults(run="lab:list_robots")
    shell = actions.add_parser("shell", help="log in on a robot, or run a command there as ssh does")
    shell.add_argument("robot", metavar="ROBOT", help="name of the robot")
    shell.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND", help="what its shell runs")
    shell.set_defaults(run="lab:shell")
    _lab_move(actions)
    config = actions.add_parser("ssh-config", help="print a configuration for ssh -F, scp -F, rsync and Ansible")
    config.set_defaults(run="lab:print_ssh_config")
    actions.add_parser("down", help="end the robots").set_defaults(run="lab:down")
    plot = actions.add_parser(
        "plot", help="draw the robots that are up, or would be, from above, and how well they hear each other"
    )
    shared.add_robots(plot)
    plot.add_argument(
        "-o", "--out", type=Path, default=Path("lab.svg"), metavar="FILE", help="SVG, PDF or PNG (default lab.svg)"
    )
    plot.set_defaults(run="lab:plot")


def _lab_move(actions: Commands) -> None:
    parser: Parser = actions.add_parser(
        "move",
        help="put a robot elsewhere, at once",
        usage="%(prog)s [-h] ROBOT (--to EAST NORTH [UP] | --by EAST NORTH [UP])",
        description="Put a robot elsewhere, at once. Lengths have units (20m, -30ft) and are its antenna's.",
    )
    parser.takes_lengths = True
    parser.add_argument("robot", metavar="ROBOT", help="name of the robot")
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument(
        "--to",
        nargs="+",
        type=str.strip,
        metavar="LENGTH",
        help="EAST NORTH [UP] in the world; on the ground without UP",
    )
    way.add_argument(
        "--by",
        nargs="+",
        type=str.strip,
        metavar="LENGTH",
        help="EAST NORTH [UP] from where it is, UP over the ground",
    )
    parser.set_defaults(run="lab:move")

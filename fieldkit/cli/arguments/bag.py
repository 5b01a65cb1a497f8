"""What `fieldkit bag` takes."""

from pathlib import Path
from typing import Final

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser

STORAGES: Final = ("mcap", "sqlite3")
DISTRIBUTIONS: Final = ("noetic", "foxy", "humble", "jazzy", "kilted")
"""Whose message types `bags.worker` has, which a test sees."""


def add(parser: Parser) -> None:
    """Declare what `fieldkit bag` takes."""
    parser.description = "Bags of ROS 1 (.bag) and ROS 2 (SQLite, MCAP), without ROS. A bag is never changed."
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    info = actions.add_parser("info", help="what a bag holds, by its index")
    shared.add_bag(info)
    shared.add_json(info)
    info.set_defaults(run="bag:info")
    check = actions.add_parser("check", help="read every message of bags, and tell what is wrong")
    check.add_argument("bags", type=Path, nargs="+", metavar="BAG", help=shared.BAG_HELP)
    check.set_defaults(run="bag:check")
    repair = actions.add_parser("repair", help="write what can be read of a damaged bag into a new one")
    shared.add_bag(repair)
    repair.add_argument("to", type=Path, metavar="NEW", help="the new bag, of the same format")
    repair.set_defaults(run="bag:repair")
    convert = actions.add_parser(
        "convert",
        help="write a bag in another format",
        epilog="example: fieldkit bag convert scan.bag scan --storage mcap --distribution humble",
    )
    shared.add_bag(convert)
    convert.add_argument("to", type=Path, metavar="NEW", help="NAME.bag for ROS 1, else a folder for ROS 2")
    convert.add_choice("--storage", STORAGES, default=STORAGES[0], help="of a bag of ROS 2 (default: mcap)")
    convert.add_choice(
        "--distribution",
        DISTRIBUTIONS,
        help=f"whose message types it has: {', '.join(DISTRIBUTIONS)} (default: noetic or jazzy)",
    )
    convert.set_defaults(run="bag:convert")

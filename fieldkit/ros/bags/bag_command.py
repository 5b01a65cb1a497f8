"""`fieldkit bag`: inspect, check, repair and convert bags."""

import argparse
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import print_table, show_error, show_note
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import EvidenceError, FieldkitError, shell_command
from fieldkit.core.text import json_text, print_text
from fieldkit.core.units import format_bytes, format_count, format_duration
from fieldkit.ros.bags import contents
from fieldkit.ros.bags.contents import BagContents
from fieldkit.ros.bags.formats import LAST_RESORT, BagFormat

STORAGES: Final = ("mcap", "sqlite3")
DISTRIBUTIONS: Final = ("noetic", "foxy", "humble", "jazzy", "kilted")
"""Distributions with message types in `bags.worker`; a test checks this."""


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit bag`."""
    parser.description = (
        "Inspect, check, repair and convert bags of ROS 1 (.bag) and ROS 2 (SQLite, MCAP). ROS need not be "
        "installed. A bag is never changed."
    )
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    action = actions.add_parser("info", help="list the contents of a bag from its index")
    shared.add_bag(action)
    action.add_argument("--json", action="store_true", help="print the contents as one JSON object")
    action.set_defaults(run=f"{__name__}:info")
    action = actions.add_parser("check", help="read every message of bags and report all problems")
    action.add_argument("bags", type=Path, nargs="+", metavar="BAG", help=shared.BAG_HELP)
    action.set_defaults(run=f"{__name__}:check")
    action = actions.add_parser("repair", help="write the readable messages of a damaged bag into a new one")
    shared.add_bag(action)
    action.add_argument("to", type=Path, metavar="NEW", help="the new bag, of the same format")
    action.set_defaults(run=f"{__name__}:repair")
    action = actions.add_parser(
        "convert",
        help="write a bag in another format",
        epilog="example: fieldkit bag convert scan.bag scan --storage mcap --distribution humble",
    )
    shared.add_bag(action)
    action.add_argument("to", type=Path, metavar="NEW", help="NAME.bag for ROS 1, else a folder for ROS 2")
    action.add_choice(
        "--storage", STORAGES, default=STORAGES[0], help="storage format of a ROS 2 bag (default: mcap)"
    )
    action.add_choice(
        "--distribution",
        DISTRIBUTIONS,
        help=f"distribution of its message types: {', '.join(DISTRIBUTIONS)} (default: noetic or jazzy)",
    )
    action.set_defaults(run=f"{__name__}:convert")


def info(arguments: argparse.Namespace) -> int:
    """Print the contents of a bag from its index, and its problems."""
    bag_contents = contents.inspect(arguments.bag)
    if arguments.json:
        print_text(json_text(asdict(bag_contents) | {"messages": bag_contents.messages}))
    else:
        _show(arguments.bag, bag_contents)
    return EvidenceError.exit_code if bag_contents.problems else 0


def _show(path: Path, bag_contents: BagContents) -> None:
    if bag_contents.problems:
        print_text(f"{path}: {bag_contents.format}, {format_bytes(bag_contents.size_bytes)}, damaged")
    else:
        count = format_count(bag_contents.messages, "message")
        print_text(f"{path}: {bag_contents.format}, {format_bytes(bag_contents.size_bytes)}, {count}")
    if bag_contents.messages:
        start_time = datetime.fromtimestamp(bag_contents.started_utc_ns / 1e9, UTC)
        print_text(f"{start_time:%Y-%m-%d %H:%M:%S} UTC, {format_duration(bag_contents.duration_s)}")
    rows = [
        (topic.name, topic.type, str(topic.messages), _rate(topic.messages, bag_contents.duration_s))
        for topic in bag_contents.topics
    ]
    if rows:
        print_table(("topic", "type", "messages", "Hz"), rows, right=(2, 3))
    _show_problems(path, bag_contents)


def _rate(messages: int, duration_s: float) -> str:
    return f"{(messages - 1) / duration_s:.4g}" if messages > 1 and duration_s > 0 else ""


def _show_problems(path: Path, bag_contents: BagContents) -> None:
    for problem in bag_contents.problems:
        show_error(f"{path}: {problem}")
    if bag_contents.recoverable_messages:
        repair = shell_command("fieldkit", "bag", "repair", path, "NEW")
        show_note(f"{format_count(bag_contents.recoverable_messages, 'message')} can be recovered: {repair}")
    elif bag_contents.problems:
        show_note("; ".join(filter(None, ("no message can be recovered", LAST_RESORT.get(bag_contents.format)))))


def check(arguments: argparse.Namespace) -> int:
    """Read every message of bags and print their problems. An unreadable bag does not stop the command."""
    return max(map(_check_bag, arguments.bags))


def _check_bag(path: Path) -> int:
    """Print the problems of a bag, and return the exit code."""
    try:
        bag_contents = contents.inspect(path, read_all=True)
    except FieldkitError as error:
        show_error(str(error))
        return error.exit_code
    if bag_contents.problems:
        _show_problems(path, bag_contents)
        return EvidenceError.exit_code
    print_text(f"{path}: intact, {format_count(bag_contents.messages, 'message')}")
    return 0


def repair(arguments: argparse.Namespace) -> int:
    """Write the readable messages of a bag into a new one."""
    result = contents.repair(arguments.bag, arguments.to)
    print_text(f"{arguments.to}: {format_count(result.messages or 0, 'message')} recovered")
    for note in result.notes:
        show_note(f"{arguments.bag}: {note}")
    return 0


def convert(arguments: argparse.Namespace) -> int:
    """Convert a bag."""
    result = contents.convert(
        arguments.bag,
        arguments.to,
        storage=BagFormat(arguments.storage),
        distribution=arguments.distribution or "",
    )
    for note in result.notes:
        show_note(note)
    _show(arguments.to, contents.inspect(arguments.to))
    return 0

"""`fieldkit bag`: look into bags, check them, save what can be read of a damaged one, convert them."""

import argparse
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fieldkit.bags import contents
from fieldkit.bags.contents import BagContents
from fieldkit.bags.formats import LAST_RESORT, BagFormat
from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_error, show_note, table
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import EvidenceError, FieldkitError, typed
from fieldkit.core.printing import say
from fieldkit.core.text import json_text
from fieldkit.core.units import format_bytes, format_count, format_duration

STORAGES: Final = ("mcap", "sqlite3")
DISTRIBUTIONS: Final = ("noetic", "foxy", "humble", "jazzy", "kilted")
"""Whose message types `bags.worker` has, which a test sees."""


def add(parser: Parser) -> None:
    """Declare what `fieldkit bag` takes."""
    parser.description = "Bags of ROS 1 (.bag) and ROS 2 (SQLite, MCAP), without ROS. A bag is never changed."
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    action = actions.add_parser("info", help="what a bag holds, by its index")
    shared.add_bag(action)
    shared.add_json(action)
    action.set_defaults(run=info)
    action = actions.add_parser("check", help="read every message of bags, and tell what is wrong")
    action.add_argument("bags", type=Path, nargs="+", metavar="BAG", help=shared.BAG_HELP)
    action.set_defaults(run=check)
    action = actions.add_parser("repair", help="write what can be read of a damaged bag into a new one")
    shared.add_bag(action)
    action.add_argument("to", type=Path, metavar="NEW", help="the new bag, of the same format")
    action.set_defaults(run=repair)
    action = actions.add_parser(
        "convert",
        help="write a bag in another format",
        epilog="example: fieldkit bag convert scan.bag scan --storage mcap --distribution humble",
    )
    shared.add_bag(action)
    action.add_argument("to", type=Path, metavar="NEW", help="NAME.bag for ROS 1, else a folder for ROS 2")
    action.add_choice("--storage", STORAGES, default=STORAGES[0], help="of a bag of ROS 2 (default: mcap)")
    action.add_choice(
        "--distribution",
        DISTRIBUTIONS,
        help=f"whose message types it has: {', '.join(DISTRIBUTIONS)} (default: noetic or jazzy)",
    )
    action.set_defaults(run=convert)


def info(arguments: argparse.Namespace) -> int:
    """Print what a bag holds by its index, and what is wrong with that."""
    found = contents.inspect(arguments.bag)
    if arguments.json:
        say(json_text(asdict(found) | {"messages": found.messages}))
    else:
        _show(arguments.bag, found)
    return EvidenceError.exit_code if found.problems else 0


def _show(path: Path, found: BagContents) -> None:
    if found.problems:
        say(f"{path}: {found.format}, {format_bytes(found.size_bytes)}, damaged")
    else:
        count = format_count(found.messages, "message")
        say(f"{path}: {found.format}, {format_bytes(found.size_bytes)}, {count}")
    if found.messages:
        begun = datetime.fromtimestamp(found.started_utc_ns / 1e9, UTC)
        say(f"{begun:%Y-%m-%d %H:%M:%S} UTC, {format_duration(found.duration_s)}")
    rows = [
        (topic.name, topic.type, str(topic.messages), _rate(topic.messages, found.duration_s))
        for topic in found.topics
    ]
    if rows:
        table(("topic", "type", "messages", "Hz"), rows, right=(2, 3))
    _tell(path, found)


def _rate(messages: int, duration_s: float) -> str:
    return f"{(messages - 1) / duration_s:.4g}" if messages > 1 and duration_s > 0 else ""


def _tell(path: Path, found: BagContents) -> None:
    for problem in found.problems:
        show_error(f"{path}: {problem}")
    if found.savable:
        repair = typed("fieldkit", "bag", "repair", path, "NEW")
        show_note(f"{format_count(found.savable, 'message')} can be saved: {repair}")
    elif found.problems:
        show_note("; ".join(filter(None, ("no message can be saved", LAST_RESORT.get(found.format)))))


def check(arguments: argparse.Namespace) -> int:
    """Read every message of bags, and print what is wrong; of a bag that cannot be read as well, and go on."""
    return max(map(_checked, arguments.bags))


def _checked(path: Path) -> int:
    """Print what is wrong with a bag, and return the exit code."""
    try:
        found = contents.inspect(path, read_all=True)
    except FieldkitError as error:
        show_error(str(error))
        return error.exit_code
    if found.problems:
        _tell(path, found)
        return EvidenceError.exit_code
    say(f"{path}: whole, {format_count(found.messages, 'message')}")
    return 0


def repair(arguments: argparse.Namespace) -> int:
    """Save what can be read of a bag."""
    found = contents.repair(arguments.bag, arguments.to)
    say(f"{arguments.to}: {format_count(found.messages or 0, 'message')} saved")
    for note in found.notes:
        show_note(f"{arguments.bag}: {note}")
    return 0


def convert(arguments: argparse.Namespace) -> int:
    """Convert a bag."""
    found = contents.convert(
        arguments.bag,
        arguments.to,
        storage=BagFormat(arguments.storage),
        distribution=arguments.distribution or "",
    )
    for note in found.notes:
        show_note(note)
    _show(arguments.to, contents.inspect(arguments.to))
    return 0

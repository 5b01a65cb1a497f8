"""Arguments that several commands share. Help and completion must start fast, so the imports are few."""

import argparse
from pathlib import Path
from typing import Final

from fieldkit.cli.parser import Parser
from fieldkit.config.locations import SITE_FILE
from fieldkit.core import permissions, plugins
from fieldkit.core.model import MAX_REPEATS, Protocol, Topology
from fieldkit.core.text import sanitized

TABLES: Final = ("table", "csv", "json", "markdown")
PATH_HELP: Final = "folder of a trial, CSV file with the columns of trial.csv, or folder with trials at any depth"
CONDITION: Final = "procedure,scenario,topology,backend,distance,distance_m,protocol"
"""Equal to `analysis.quantities.DEFAULT_BY`; a test compares them."""

LAB_PROFILE: Final = "turtlebot3_burger"
"""Profile of the robots that `--robots` adds."""

_MAX_DIGITS: Final = 15
"""Maximum number of digits of a whole number. A float represents all numbers of this length exactly."""

_PROTOCOL_HELP: Final = "may be given more than once (default: the procedure's)"


def add_site(parser: Parser, default: str = "the site file's, or emulated without a site file") -> None:
    """Add the options for the backend and the site file; `default` describes the default of `--backend`."""
    names = ", ".join(point.name for point in plugins.entry_points(plugins.BACKENDS))
    parser.add_argument(
        "--backend",
        metavar="NAME",
        help=f"one of: {names} (default: {default})",
    )
    parser.add_argument(
        "--site",
        type=Path,
        metavar="FILE",
        help=f"site file of the lab (default: {SITE_FILE}, if there is one)",
    )


def add_operator(parser: Parser) -> None:
    """Add the options for questions to the operator, and one for each permission."""
    answers = parser.add_mutually_exclusive_group()
    answers.add_argument(
        "--yes",
        action="store_true",
        help="do not ask the operator for anything; assume that the robots are in position",
    )
    answers.add_argument("--answers", metavar="FILE", help="answers, a line per request; -: read from standard input")
    for name, permission in permissions.installed().items():
        parser.add_argument(permissions.option(name), action="store_true", help=permission.help_line)


def add_junit(parser: Parser) -> None:
    """Add the option for CI servers."""
    parser.add_argument(
        "--junit",
        type=file_to_write,
        metavar="FILE",
        help="also write repeats and expectations as JUnit XML for CI servers",
    )


BAG_HELP: Final = "a .bag, .db3 or .mcap file, or the folder of a bag of ROS 2"


def add_bag(parser: Parser) -> None:
    """Add the argument for the bag that a command reads."""
    parser.add_argument("bag", type=Path, metavar="BAG", help=BAG_HELP)


def add_json(parser: Parser) -> None:
    """Add the option for output that programs read."""
    parser.add_argument("--json", action="store_true", help="print events as JSON, one per line")


def add_all(parser: Parser) -> None:
    """Add the option that shows every quantity."""
    parser.add_argument("--all", action="store_true", help="show every quantity in the table, not only the main ones")


def add_out(parser: Parser, contents: str) -> None:
    """Add the option for the folder of results."""
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", default=Path("trials"), help=f"folder for {contents} (default: trials/)"
    )


def add_overrides(parser: Parser) -> None:
    """Add the options that override settings of the procedure."""
    parser.add_choice("--topology", map(str, Topology), help="default: the procedure's")
    parser.add_choice("--protocol", map(str, Protocol), action="append", help=_PROTOCOL_HELP)
    parser.add_argument("--repeats", type=repeats, metavar="N", help="per protocol (default: the procedure's)")
    parser.add_argument("--record", metavar="DURATION", help="length of every recording, for example 2s")


def add_robots(parser: Parser) -> None:
    """Add the options that select the robots of a lab."""
    add_site(parser, "emulated")
    parser.add_argument(
        "--robots", type=natural, metavar="N", help="use robots robot-1 to robot-N instead of those in the site file"
    )
    parser.add_argument("--profile", metavar="NAME", help=f"profile of the N robots (default {LAB_PROFILE})")


def add_trial(parser: Parser, help_line: str = "folder of a trial") -> None:
    """Add the argument for the folder of one trial."""
    parser.add_argument("trial", type=Path, metavar="TRIAL", help=help_line)


def add_paths(parser: Parser) -> None:
    """Add PATH..., `--rebuild` and `--no-index`, which `sources.find` reads."""
    parser.add_argument("paths", type=Path, nargs="+", metavar="PATH", help=PATH_HELP)
    add_rebuild(parser)


def add_where(parser: Parser) -> None:
    """Add `--where`, which `Sources.with_filter` reads."""
    parser.add_argument(
        "--where",
        default="",
        metavar="EXPRESSION",
        help="use only the attempts for which it is true: comparisons of columns, with and, or, not, in; for example "
        "'distance_m < 20 and topology == \"master\"'",
    )


def add_rebuild(parser: Parser) -> None:
    """Add `--rebuild` and `--no-index`."""
    parser.add_argument(
        "--rebuild", action="store_true", help="compute values from the raw evidence instead of reading trial.csv"
    )
    parser.add_argument(
        "--no-index",
        dest="use_index",
        action="store_false",
        help="read all tables instead of an index of their rows; takes longer, the result is the same",
    )


def add_cells(parser: Parser, default: str = CONDITION) -> None:
    """Add `--by`, which `Sources.condition` reads."""
    parser.add_argument(
        "--by",
        default=default,
        metavar="COLUMN,...",
        help=f"columns that distinguish conditions, or `source`, the folder or file of a row; conditions are sorted "
        f"by them in this order (default {default})",
    )


def add_jobs(parser: argparse._ActionsContainer) -> None:
    """Add the option for the number of processes on this machine."""
    parser.add_argument(
        "--jobs",
        type=positive,
        metavar="N",
        help="number of parallel processes (default: the number of processors)",
    )


def add_workers(parser: Parser) -> None:
    """Add the options that choose where tasks run; `executors.Workers` contains their values."""
    workers = parser.add_mutually_exclusive_group()
    add_jobs(workers)
    workers.add_argument(
        "--cluster",
        default="",
        metavar="ADDRESS",
        help="use the workers of a Dask scheduler: tcp://HOST:PORT, or its scheduler file (see fieldkit docs sweep)",
    )


def add_show(parser: Parser, dest: str, what: str) -> None:
    """Add `show NAME` to a listing command. NAME is stored in the attribute `dest`, which is None without `show`."""
    parser.usage = "%(prog)s [-h] [show NAME]"
    show = parser.add_commands(metavar="show NAME", prog=parser.prog).add_parser("show", help=f"show one {what}")
    show.add_argument(dest, metavar="NAME", help=f"name of the {what}")
    parser.set_defaults(**{dest: None})


def file_to_write(text: str) -> Path:
    """Return a path in a folder that exists; argparse reports others, and folders, before the trial starts."""
    path = Path(text)
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {str(path.parent)!r}")
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is a folder, not a file")
    return path


def natural(text: str, minimum: int = 0) -> int:
    """Return a whole number with at most 15 digits; argparse reports other texts as errors.

    `minimum` is only named in the message; the caller must check it.
    """
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is not a whole number of at least {minimum}")
    if len(text) > _MAX_DIGITS:
        raise argparse.ArgumentTypeError(f"a number of {len(text)} digits is too large")
    return int(text)


def positive(text: str) -> int:
    """Return a whole number from 1; argparse reports other texts."""
    if natural(text, minimum=1) < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return int(text)


def repeats(text: str) -> int:
    """Return a number of repeats from 1 to `MAX_REPEATS`; argparse reports other texts."""
    if not 1 <= natural(text, minimum=1) <= MAX_REPEATS:
        raise argparse.ArgumentTypeError(f"must be at least 1, and at most {MAX_REPEATS}")
    return int(text)


def free_text(text: str) -> str:
    """Return a text with `?` instead of bytes that are not UTF-8 and of unprintable characters; see `sanitized`."""
    return sanitized(text)

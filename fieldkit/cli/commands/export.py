"""`fieldkit export PATH...`: trials for other programs."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, BinaryIO, Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_note
from fieldkit.cli.parser import Parser
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.text import print_text
from fieldkit.core.units import format_bytes

if TYPE_CHECKING:
    from fieldkit.analysis.repeats import Repeats


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit export`."""
    parser.description = (
        "Write the rows of trials as one table, the events of one trial as a time line, or the results of repeats "
        "and expectations for CI servers."
    )
    shared.add_paths(parser)
    parser.add_choice(
        "--format",
        ("csv", "parquet", "mcap", "junit"),
        required=True,
        help="csv or parquet: the rows of all trials as one table; mcap: the time line of one trial, for "
        "Foxglove; junit: repeats and expectations, for CI servers",
    )
    parser.add_argument(
        "-o", "--out", required=True, type=Path, metavar="FILE", help="the file, which must not exist"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print its size."""
    out: Path = arguments.out
    if out.exists():
        raise ConfigurationError(
            "this file exists and is not overwritten",
            where=str(out),
            remedy=shell_command("mv", out, f"{out}.old") if out.is_file() else "choose another -o",
        )
    try:
        with files.replacing(out) as file:
            _WRITERS[arguments.format](arguments, file)
            size_bytes = file.tell()
    except OSError as error:
        if error.filename not in {None, str(out)}:
            raise  # a trial cannot be read
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(out), remedy="choose another -o"
        ) from error
    print_text(f"wrote {out} ({format_bytes(size_bytes)})")
    return 0


def _csv(arguments: argparse.Namespace, file: BinaryIO) -> None:
    from fieldkit.export import table

    table.write_csv(file, _load(arguments))


def _parquet(arguments: argparse.Namespace, file: BinaryIO) -> None:
    from fieldkit.export import table

    table.write_parquet(file, _load(arguments))


def _load(arguments: argparse.Namespace) -> "Repeats":
    from fieldkit.trial.stored import sources

    data = sources.find(arguments.paths, show_note, rebuild=arguments.rebuild, use_index=arguments.use_index)
    return data.read(undeclared=True)


def _mcap(arguments: argparse.Namespace, file: BinaryIO) -> None:
    from fieldkit.export import mcap, timeline
    from fieldkit.trial.stored import plans, remeasured

    folder: Path = arguments.paths[0]
    if len(arguments.paths) > 1:
        raise ConfigurationError(
            f"an MCAP file contains one trial, but {len(arguments.paths)} are given",
            remedy="one at a time: "
            + shell_command("fieldkit", "export", folder, "--format", "mcap", "-o", f"{folder.name}.mcap"),
        )
    plan = plans.read_plan(folder)
    remeasured.note_differences(folder, show_note)
    mcap.write(file, timeline.about(plan), timeline.messages(folder, plan))


def _junit(arguments: argparse.Namespace, file: BinaryIO) -> None:
    from fieldkit.export import junit
    from fieldkit.trial.stored import sources

    # `rebuild=True` includes trials without a table, because a CI server must show all trials.
    trials = sources.find(arguments.paths, show_note, rebuild=True).tables
    file.write(junit.text(table.parent for table in trials))


_WRITERS: Final[Mapping[str, Callable[[argparse.Namespace, BinaryIO], None]]] = MappingProxyType(
    {"csv": _csv, "parquet": _parquet, "mcap": _mcap, "junit": _junit}
)

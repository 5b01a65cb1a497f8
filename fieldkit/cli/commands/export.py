"""`fieldkit export PATH...`: trials for other programs."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, Final

from fieldkit.analysis.repeats import Repeats
from fieldkit.cli.display import show_note
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, typed
from fieldkit.core.units import format_bytes
from fieldkit.export import junit, mcap, table, timeline
from fieldkit.trial import sources, store


def run(arguments: argparse.Namespace) -> int:
    """Write the file and say how large it is."""
    out: Path = arguments.out
    if out.exists():
        raise ConfigurationError(
            "there is a file of this name, which is not overwritten",
            where=str(out),
            remedy=typed("mv", out, f"{out}.old") if out.is_file() else "choose another -o",
        )
    try:
        with files.replacing(out) as file:
            _WRITERS[arguments.format](arguments, file)
            size_bytes = file.tell()
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(out), remedy="choose another -o"
        ) from error
    print(f"wrote {out} ({format_bytes(size_bytes)})")
    return 0


def _csv(arguments: argparse.Namespace, file: BinaryIO) -> None:
    table.write_csv(file, _load(arguments))


def _parquet(arguments: argparse.Namespace, file: BinaryIO) -> None:
    table.write_parquet(file, _load(arguments))


def _load(arguments: argparse.Namespace) -> Repeats:
    return sources.find(arguments.paths, show_note, rebuild=arguments.rebuild).read(undeclared=True)


def _mcap(arguments: argparse.Namespace, file: BinaryIO) -> None:
    folder: Path = arguments.paths[0]
    if len(arguments.paths) > 1:
        raise ConfigurationError(
            f"an MCAP file holds one trial, {len(arguments.paths)} are named",
            remedy="one at a time: "
            + typed("fieldkit", "export", folder, "--format", "mcap", "-o", f"{folder.name}.mcap"),
        )
    plan = store.read_plan(folder)
    sources.note_differences(folder, show_note)
    mcap.write(file, timeline.about(plan), timeline.messages(folder, plan))


def _junit(arguments: argparse.Namespace, file: BinaryIO) -> None:
    file.write(junit.text(table.parent for table in sources.find(arguments.paths, show_note).tables))


_WRITERS: Final[Mapping[str, Callable[[argparse.Namespace, BinaryIO], None]]] = MappingProxyType(
    {"csv": _csv, "parquet": _parquet, "mcap": _mcap, "junit": _junit}
)

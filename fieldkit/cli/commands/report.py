"""`fieldkit report PATH...`: one page with the results of trials, and its figures."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_note
from fieldkit.cli.parser import Parser
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.text import print_text


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit report`."""
    parser.description = (
        "Make one HTML file of figures, tables and strips. It begins with what is missing and with the worst "
        "conditions. It opens without a network and contains no script. For the folder of a campaign, or the folder "
        "above, it lists planned trials without an attempt."
    )
    shared.add_paths(parser)
    shared.add_where(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE",
        help="the page (default report.html)",
    )
    parser.add_argument("--title", default="", help="its title (default: made from the procedures)")
    parser.add_argument(
        "--repeat",
        default="",
        metavar="NAME",
        help="repeat for the time line: udp-07, or TRIAL/udp-07 (default: the median one of the worst condition)",
    )
    parser.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="column to draw in addition to the default ones; may be given more than once",
    )
    parser.add_argument(
        "--figures",
        type=Path,
        metavar="FOLDER",
        help="also write the figures there as SVG, PDF and PNG, in the width of a paper's column",
    )
    parser.set_defaults(run=run)


_OUT: Final = Path("report.html")
_OTHER_FORMATS: Final = frozenset({".csv", ".json", ".md", ".pdf", ".png", ".svg", ".tex"})
"""Suffixes of files that programs would not open as a page."""
_PAGE: Final = b"<!DOCTYPE html>"


def run(arguments: argparse.Namespace) -> int:
    """Write the page, and with --figures the figures."""
    # matplotlib takes half a second to import, so other commands must not import it.
    from fieldkit.campaign.plan import unmeasured
    from fieldkit.report import contents, figures, page
    from fieldkit.trial import sources

    out, folder = arguments.out, arguments.figures
    _require_writable(out)
    data = sources.find(
        arguments.paths, show_note, rebuild=arguments.rebuild, use_index=arguments.use_index
    ).with_filter(arguments.where)
    selected_names = [data.quantity(name).name for name in arguments.quantity]
    repeats = data.read()
    with_attempts = (
        {str(table.parent) for table in data.tables} if arguments.where else set(repeats.texts["source"].tolist())
    )
    report_contents = contents.build_contents(
        repeats,
        title=arguments.title,
        repeat=arguments.repeat,
        command=_command(arguments),
        paths=list(map(str, arguments.paths)),
        quantities=selected_names,
        unmeasured=list(unmeasured(arguments.paths, with_attempts, show_note)),
        sweep=data.sweep_columns,
    )
    with _explain_os_errors(out, "-o"):
        files.write(out, page.render(report_contents, out).encode())
    print_text(out)
    if folder is not None:
        with _explain_os_errors(folder, "--figures"):
            folder.mkdir(parents=True, exist_ok=True)
            for path in figures.save(report_contents.charts, folder):
                print_text(path)
    return 0


def _require_writable(out: Path) -> None:
    """Raise an error before the work if no page can be written there. Only a report may be overwritten."""
    if not out.parent.is_dir():
        raise ConfigurationError(
            "there is no such folder", where=str(out.parent), remedy=shell_command("mkdir", "-p", out.parent)
        )
    if out.is_dir():
        raise ConfigurationError(
            "this is a folder", where=str(out), remedy=f"name a file: {shell_command('-o', out / _OUT)}"
        )
    if out.exists() and not _is_page(out):
        raise ConfigurationError(
            "this file is not a report, and is not overwritten",
            where=str(out),
            remedy="choose another -o",
        )
    if out.suffix.lower() in _OTHER_FORMATS:
        raise ConfigurationError(
            "a report is a page of HTML",
            where=str(out),
            remedy=f"name a file: {shell_command('-o', out.with_suffix('.html'))}; for figures --figures FOLDER",
        )


def _is_page(out: Path) -> bool:
    """Return True if a file is a report or empty. A pipe is not read, because that would block."""
    if not out.is_file():
        return False
    with _explain_os_errors(out, "-o"), out.open("rb") as file:
        return file.read(len(_PAGE)) in {b"", _PAGE}


@contextmanager
def _explain_os_errors(path: Path, option: str) -> Iterator[None]:
    """Turn an OSError of the body into a ConfigurationError with the path and the option."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(path), remedy=f"choose another {option}"
        ) from error


def _command(arguments: argparse.Namespace) -> list[str]:
    """Return the words of the command that regenerates the page."""
    words = ["fieldkit", "report", *map(str, arguments.paths), "-o", str(arguments.out)]
    words += ["--title", arguments.title] if arguments.title else []
    words += ["--where", arguments.where] if arguments.where else []
    words += [word for name in arguments.quantity for word in ("--quantity", name)]
    return words + (["--repeat", arguments.repeat] if arguments.repeat else [])

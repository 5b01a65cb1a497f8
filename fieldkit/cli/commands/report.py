"""`fieldkit report PATH...`: one page with the results of trials, and its figures."""

import argparse
from pathlib import Path

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_note
from fieldkit.cli.parser import Parser
from fieldkit.core.text import print_text


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit report`."""
    parser.description = (
        "Write one HTML file with figures and tables. It starts with missing data and the worst conditions. It opens "
        "without a network and contains no script. For the folder of a campaign, or its parent folder, it also lists "
        "planned trials without an attempt."
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
    parser.add_argument("--title", default="", help="title of the page (default: derived from the procedures)")
    parser.add_argument(
        "--repeat",
        default="",
        metavar="NAME",
        help="repeat for the time line: udp-07, or TRIAL/udp-07 (default: the median repeat of the worst condition)",
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


def run(arguments: argparse.Namespace) -> int:
    """Write the page, and with --figures the figures."""
    # matplotlib takes half a second to import, so other commands must not import it.
    from fieldkit.campaign.plan import unmeasured
    from fieldkit.report import contents, figures, page
    from fieldkit.trial.stored import sources

    out, folder = arguments.out, arguments.figures
    page.require_writable(out)
    data = sources.find(
        arguments.paths, show_note, rebuild=arguments.rebuild, use_index=arguments.use_index
    ).with_filter(arguments.where)
    quantity_names = [data.quantity(name).name for name in arguments.quantity]
    repeats = data.read()
    folders_with_attempts = (
        {str(table.parent) for table in data.tables} if arguments.where else set(repeats.texts["source"].tolist())
    )
    report_contents = contents.build_contents(
        repeats,
        title=arguments.title,
        repeat=arguments.repeat,
        command=_command(arguments),
        paths=list(map(str, arguments.paths)),
        quantities=quantity_names,
        unmeasured=list(unmeasured(arguments.paths, folders_with_attempts, show_note)),
        sweep=data.sweep_columns,
    )
    page.write(report_contents, out)
    print_text(out)
    if folder is not None:
        with page.explaining_write_errors(folder, "--figures"):
            folder.mkdir(parents=True, exist_ok=True)
            for path in figures.save(report_contents.charts, folder):
                print_text(path)
    return 0


def _command(arguments: argparse.Namespace) -> list[str]:
    """Return the words of the command that regenerates the page."""
    words = ["fieldkit", "report", *map(str, arguments.paths), "-o", str(arguments.out)]
    words += ["--title", arguments.title] if arguments.title else []
    words += ["--where", arguments.where] if arguments.where else []
    words += [word for name in arguments.quantity for word in ("--quantity", name)]
    return words + (["--repeat", arguments.repeat] if arguments.repeat else [])

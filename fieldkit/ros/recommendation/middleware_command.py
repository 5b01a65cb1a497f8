"""`fieldkit middleware recommend`: write the middleware configuration that met a criterion on the measured link."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.analysis.quantities import parse_amount
from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_note
from fieldkit.cli.parser import Parser
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.text import print_text, sanitized
from fieldkit.core.units import BYTES_PER_UNIT, parse_quantity
from fieldkit.ros.recommendation import configurations

if TYPE_CHECKING:
    from fieldkit.ros.recommendation.candidates import Assessment
    from fieldkit.ros.recommendation.link_cells import LinkCriterion


_EPILOG = """\
exit codes: 0 if a file was written for at least one middleware; 1 if no file was written, because no
configuration passed or the evidence is not sufficient.

example: fieldkit middleware recommend trials/ -o config/ --max-loss 1% --max-delay 200ms"""


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit middleware`."""
    parser.description = "Recommend settings of middlewares from measured trials."
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    action = actions.add_parser(
        "recommend",
        help="write the configuration that passed on the measured link",
        description="Write the configuration of CycloneDDS, Fast DDS or Zenoh that passed on the measured link, with "
        "the evidence in its comment. Exit code 0: a file was written; 1: no file was written, because no "
        "configuration passed or the evidence is not sufficient.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    action.add_argument("trials", type=Path, nargs="+", metavar="TRIALS", help=shared.PATH_HELP)
    action.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder for the written files"
    )
    action.add_argument(
        "--max-loss", default="1%", metavar="SHARE", help="largest loss of samples in each repeat (default 1%%)"
    )
    action.add_argument(
        "--max-delay",
        metavar="TIME",
        help="largest delay of 95 %% of the sent samples, for example 200ms (default: none)",
    )
    action.add_argument("--size", metavar="BYTES", help="only samples of this size: 100kB (default: all)")
    action.add_argument(
        "--repeats", type=shared.natural, default=5, metavar="N", help="valid repeats needed (default 5)"
    )
    action.add_argument(
        "--share",
        metavar="SHARE",
        help="share of all repeats that must meet the limits, shown with 95 %% confidence (default: every "
        "measured repeat must meet them)",
    )
    action.set_defaults(run=f"{__name__}:recommend")


NOTHING_WRITTEN: int = 1
"""Exit code if no file was written."""


def recommend(arguments: argparse.Namespace) -> int:
    """Write a file for each middleware with settings that passed."""
    from fieldkit.analysis.expectations import MAX_SHARE
    from fieldkit.ros.recommendation import candidates
    from fieldkit.ros.recommendation.candidates import Assessment
    from fieldkit.ros.recommendation.link_cells import LinkCriterion
    from fieldkit.trial.stored import sources

    if arguments.repeats < 2:
        raise ConfigurationError("--repeats: one repeat does not show the spread", remedy="write 2 or more")
    criterion = LinkCriterion(
        max_loss=_parse_share(arguments.max_loss, "--max-loss"),
        max_delay_s=None if arguments.max_delay is None else parse_amount(arguments.max_delay, "s", "--max-delay"),
        size_bytes=None if arguments.size is None else parse_quantity(arguments.size, BYTES_PER_UNIT, "--size"),
        repeats=arguments.repeats,
        share=None if arguments.share is None else _parse_share(arguments.share, "--share", maximum=MAX_SHARE),
    )
    data = sources.find(arguments.trials, show_note)
    assessments = candidates.assess(data.read(undeclared=True), criterion)
    if not assessments:
        print_text("no trial has a step topics with samples of this size; to run one, see: fieldkit docs topics")
        return NOTHING_WRITTEN
    best: dict[str, Assessment] = {}
    for assessment in assessments:
        result = "passed" if assessment.passed else "failed" if assessment.failures else "undecided"
        print_text(sanitized(f"{result}: {assessment.candidate}"))
        for reason in (*assessment.failures, *assessment.missing_evidence):
            print_text(sanitized(f"  {reason}"))
        current = best.get(assessment.candidate.middleware)
        if assessment.passed and (current is None or assessment.rank < current.rank):
            best[assessment.candidate.middleware] = assessment
    written_files = [_write(arguments, assessment, criterion) for assessment in best.values()]
    if any(written_files):
        return 0
    if best:
        print_text("nothing was written: no configuration file can contain the settings that passed")
    else:
        print_text(
            "nothing was written: no settings passed. Measure the undecided ones with more repeats, or other settings"
        )
    return NOTHING_WRITTEN


def _parse_share(text: str, option: str, maximum: float = 1.0) -> float:
    """Return the share in an option's value.

    Raises:
        ConfigurationError: It is not a share, or above `maximum`; or it is 0 and `maximum` is below 1.
    """
    share = parse_amount(text, "share", option)
    if share > maximum or (maximum < 1 and not share):
        minimum_text = "above 0" if maximum < 1 else "0"
        raise ConfigurationError(
            f"{option}: {text[:40]!r} is not a valid share",
            remedy=f"write {minimum_text} to {100 * maximum:g} %",
        )
    return share


def _write(arguments: argparse.Namespace, assessment: "Assessment", criterion: "LinkCriterion") -> bool:
    """Write a file with the settings that passed. Return False if the middleware has no file for these settings."""
    from fieldkit.ros.recommendation import candidates

    middleware = assessment.candidate.middleware
    comment = list(candidates.evidence(assessment, criterion))
    try:
        text = configurations.configuration_text(
            middleware, assessment.candidate.transport, assessment.candidate.settings_by_path, comment
        )
    except ConfigurationError as error:
        show_note(str(error))
        return False
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / configurations.FILES[middleware]
    files.write(path, text.encode())
    print_text(f"wrote {path}; set {configurations.VARIABLES[middleware]} to its path")
    return True

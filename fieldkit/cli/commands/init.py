"""`fieldkit init`: a commented site file to fill in."""

import argparse
from pathlib import Path

from fieldkit.cli.parser import Parser
from fieldkit.config.locations import SITE_FILE
from fieldkit.core.errors import shell_command
from fieldkit.core.text import print_text


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit init`."""
    parser.description = "Write a site file in which every line is explained; a file that exists is not overwritten."
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=Path(SITE_FILE), help=f"the file (default: {SITE_FILE})"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print the next commands."""
    from fieldkit.config.site import load_site
    from fieldkit.config.site_edits import create_site_file

    path: Path = arguments.out
    create_site_file(path)
    site, _ = load_site(path)
    option = () if path == Path(SITE_FILE) else ("--site", path)
    steps = [
        (f"${{EDITOR:-nano}} {shell_command(path)}", "hosts, users and keys of your robots"),
        *(
            (shell_command("fieldkit", "enroll", name, *option), f"pin the host key of {name}")
            for name in site.robots
        ),
        (shell_command("fieldkit", "check", *option), "what the robots lack"),
        (shell_command("fieldkit", "trial", "los", "30ft", "--repeats", 1, *option), "a first trial"),
    ]
    width = max(len(command) for command, _ in steps)
    print_text(f"wrote {path}; next:")
    for command, purpose in steps:
        print_text(f"  {command:{width}}  # {purpose}")
    return 0

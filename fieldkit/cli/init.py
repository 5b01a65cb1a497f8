"""`fieldkit init`: a commented site file to fill in."""

import argparse
from pathlib import Path

from fieldkit.cli.listing import Commands
from fieldkit.config import profiles, site_file


def add(commands: Commands) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "init",
        help="write a commented site file",
        description="Write a site file in which every line is explained; a file that exists is not overwritten.",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        default=Path(profiles.SITE_FILE),
        help=f"the file (default: {profiles.SITE_FILE})",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print what to type next."""
    path: Path = arguments.out
    site_file.create(path)
    site, _ = profiles.load_site(path)
    option = "" if path == Path(profiles.SITE_FILE) else f" --site {path}"
    steps = [
        (f"${{EDITOR:-nano}} {path}", "hosts, users and keys of your robots"),
        *((f"fieldkit enroll {name}{option}", f"pin the host key of {name}") for name in site.robots),
        (f"fieldkit check{option}", "what is missing on the robots"),
        (f"fieldkit trial los 30ft --repeats 1{option}", "a first trial"),
    ]
    width = max(len(command) for command, _ in steps)
    print(f"wrote {path}; next:")
    for command, what in steps:
        print(f"  {command:{width}}  # {what}")
    return 0

"""What `fieldkit robots` and `fieldkit procedures` share: list all, or show one."""

import argparse
from collections.abc import Callable
from typing import Any

from fieldkit.cli.display import table
from fieldkit.config import catalog

Commands = Any  # argparse has no public name for the object that add_subparsers returns


def add(commands: Commands, kind: catalog.Kind, load: Callable[[str], catalog.Named], what: str) -> None:
    """Add the subcommand `kind` with its own `show NAME`.

    Args:
        commands: Where to add it.
        kind: `robots` or `procedures`.
        load: Loads one by name; its result has a `summary`.
        what: One of them, for the help.
    """
    parser = commands.add_parser(kind, help=f"list {kind}, or show NAME", description=f"List {kind}, or show one.")
    parser.set_defaults(run=lambda arguments: run(kind, load, arguments))
    add_show(parser, what)


def add_show(parser: argparse.ArgumentParser, what: str) -> None:
    """Let a listing subcommand take `show NAME`."""
    parser.usage = "%(prog)s [-h] [show NAME]"
    actions = parser.add_subparsers(metavar="show NAME", prog=f"{parser.prog}")
    show = actions.add_parser("show", help=f"show one {what}")
    show.add_argument("name", metavar="NAME", help=f"name of the {what}")
    parser.set_defaults(name=None)


def run(kind: catalog.Kind, load: Callable[[str], catalog.Named], arguments: argparse.Namespace) -> int:
    """List all, or show the one named."""
    return _list(kind, load) if arguments.name is None else _show(kind, load, arguments.name)


def _list(kind: catalog.Kind, load: Callable[[str], catalog.Named]) -> int:
    rows = [(name, load(name).summary, str(path)) for name, path in catalog.names(kind).items()]
    table(("name", "summary", "file"), rows)
    return 0


def _show(kind: catalog.Kind, load: Callable[[str], catalog.Named], name: str) -> int:
    load(name)  # a file with an error is not shown as if it were good
    print(catalog.find(kind, name).read_text(encoding="utf-8"), end="")
    return 0

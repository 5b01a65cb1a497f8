"""The page of all commands, from the argument parser."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from docs.generator.markdown import page, table
from fieldkit import cli
from fieldkit.cli.commands import COMMANDS
from fieldkit.cli.parser import Parser

_WIDTH: Final = 100
_UNLIMITED_WIDTH: Final = 10_000
_ARGUMENT: Final = re.compile(r"\(.*?\)+(?=\s|$)|\[.*?\]+(?=\s|$)|\S+")
"""An argument in a usage; those in brackets contain spaces. It is argparse's expression of Python 3.11."""
DOCS: Final = Path(__file__).resolve().parents[1]

GUIDES: Final = {
    "trial": "field.md",
    "check": "checks.md",
    "clocks": "robot-state.md",
    "campaign": "campaign.md",
    "resume": "campaign.md",
    "stop": "motion.md",
    "abort": "field.md",
    "enroll": "field.md",
    "init": "field.md",
    "lab": "lab.md",
    "aggregate": "analyse.md",
    "compare": "compare.md",
    "report": "analyse.md",
    "export": "export.md",
    "bag": "bags.md",
    "bridge": "bridge.md",
    "middleware": "studies/middleware-link.md",
    "robots": "add-a-robot.md",
    "procedures": "add-a-procedure.md",
    "columns": "trial-folder.md",
    "positions": "positions.md",
    "rebuild": "trial-folder.md",
    "verify": "trial-folder.md",
    "cosim": "cosim-commands.md",
}
"""The guide of each command."""


def commands() -> str:
    """Return the page."""
    top = cli.parser()
    names = top.subcommands()
    summaries = {name: COMMANDS.get(name) or _entry_point_summary(top, name) for name in names}
    overview = table(("command", "purpose"), ((f"[`{name}`](#fieldkit-{name})", summaries[name]) for name in names))
    blocks = [
        (
            "`fieldkit COMMAND --help` prints the same text. `fieldkit --version` prints the version. See also "
            "[exit codes](exit-codes.md) and [values](../values.md)."
        ),
        overview,
    ]
    for name in names:
        parser = top.command(name)
        assert parser is not None
        parser.declare_arguments()
        blocks += [f"## fieldkit {name}", *_command(parser)]
        if name in GUIDES:
            blocks.append(f"Guide: [{_title(GUIDES[name])}](../{GUIDES[name]}).")
        blocks += list(_subcommands(parser, 3))
    return page("Commands", *blocks)


def _entry_point_summary(top: Parser, name: str) -> str:
    """Return the description of a command that an entry point adds."""
    parser = top.command(name)
    assert parser is not None
    parser.declare_arguments()
    return (parser.description or "").rstrip(".")


def _title(name: str) -> str:
    """Return the title of a page of `docs/`."""
    text = (DOCS / name).read_text(encoding="utf-8")
    return text.partition("# ")[2].partition("\n")[0]


def _subcommands(parser: Parser, level: int) -> Iterator[str]:
    for name in parser.subcommands():
        inner = parser.command(name)
        assert inner is not None
        if name == "show":
            continue  # its only argument is in the usage of the command
        yield f"{'#' * level} {inner.prog}"
        yield from _command(inner, _help(parser, name))
        yield from _subcommands(inner, level + 1)


def _help(parser: Parser, name: str) -> str:
    """Return the help line of a subcommand."""
    for action in parser._actions:  # noqa: SLF001 (argparse has no public list)
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001 (as above)
            for choice in action._choices_actions:  # noqa: SLF001 (as above)
                if choice.dest == name:
                    return choice.help or ""
    return ""


def _command(parser: Parser, summary: str = "") -> Iterator[str]:
    yield f"```text\n{_usage(parser)}\n```"
    text = parser.description or (f"{summary[:1].upper()}{summary[1:]}." if summary else "")
    yield _prose(parser, text)
    arguments = [action for action in parser._actions if _is_listed(action)]  # noqa: SLF001 (argparse has no public list)
    if arguments:
        yield table(
            ("argument", "meaning"), ((f"`{_invocation(action)}`", _meaning(parser, action)) for action in arguments)
        )
    if parser.epilog:
        yield _epilog(_expanded(parser, parser.epilog))


def _usage(parser: Parser) -> str:
    """Return the usage in lines of at most `_WIDTH` characters, wrapped only outside of brackets.

    argparse wraps the alternatives of a group in Python 3.13, but not in 3.11, so it gets an unlimited width.
    """
    formatter = argparse.HelpFormatter(parser.prog, width=_UNLIMITED_WIDTH)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups, prefix="")  # noqa: SLF001
    arguments = formatter.format_help().strip().removeprefix(parser.prog)
    lines = [parser.prog]
    for argument in _ARGUMENT.findall(arguments):
        if len(lines[-1]) + len(argument) >= _WIDTH:
            lines.append(" " * len(parser.prog))
        lines[-1] += f" {argument}"
    return "\n".join(lines)


def _is_listed(action: argparse.Action) -> bool:
    return not isinstance(action, argparse._HelpAction | argparse._SubParsersAction) and (  # noqa: SLF001
        action.help is not argparse.SUPPRESS
    )


def _invocation(action: argparse.Action) -> str:
    default_metavar = action.dest.upper() if action.option_strings else action.dest
    metavar = action.metavar or ("" if action.nargs == 0 or action.choices else default_metavar)
    value = metavar if isinstance(metavar, str) else " ".join(metavar)
    if action.choices and not action.metavar:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    if not action.option_strings:
        return value + (" ..." if action.nargs in {"+", "*", argparse.REMAINDER} else "")
    many = " ..." if action.nargs in {"+", "*"} else ""
    return ", ".join(action.option_strings) + (f" {value}{many}" if action.nargs != 0 and value else "")


def _meaning(parser: Parser, action: argparse.Action) -> str:
    words = {**vars(action), "prog": parser.prog}
    return _escape_markdown((action.help or "") % words)


def _prose(parser: Parser, text: str) -> str:
    return _escape_markdown(_expanded(parser, text))


def _expanded(parser: Parser, text: str) -> str:
    """Return a description or epilog as argparse prints it."""
    return text % {"prog": parser.prog} if "%(prog)" in text else text


def _escape_markdown(text: str) -> str:
    """Return a text with the special characters of Markdown escaped; a text with code spans is not changed."""
    return text.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_") if "`" not in text else text


def _epilog(text: str) -> str:
    if text.startswith("example: "):
        return f"```text\n{text.removeprefix('example: ')}\n```"
    return f"```text\n{text.strip()}\n```"

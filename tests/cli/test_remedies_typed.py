"""Remedies are valid commands: commands and options parse, and named files exist."""

import ast
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from fieldkit import cli
from fieldkit.cli import main
from fieldkit.cli.parser import Parser
from fieldkit.pytest.plugin_options import as_pytest_option
from tests.helpers.paths import ROOT

# As in `cli.hints`: lower-case words are commands, and the other words are their arguments.
COMMAND = re.compile(r"\bfieldkit((?: [a-z][a-z-]*)+)([^;,\n`()]*)")
OPTION = re.compile(r"--[a-z][a-z-]+")


@cache
def remedies() -> list[tuple[str, str]]:
    """Return each remedy in the source with its location; values are shown as `X`."""
    located_remedies = []
    for path in sorted([*(ROOT / "fieldkit").rglob("*.py"), *(ROOT / "sim_backends").rglob("*.py")]):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "remedy" in text else ():
            if isinstance(node, ast.keyword) and node.arg == "remedy":
                located_remedies += [
                    (f"{path.relative_to(ROOT)}:{node.value.lineno}", value) for value in texts(node.value)
                ]
    return located_remedies


def texts(node: ast.expr) -> list[str]:
    match node:
        case ast.Constant(str() as text):
            return [text]
        case ast.JoinedStr(parts):
            return ["".join(part.value if isinstance(part, ast.Constant) else "X" for part in parts)]  # type: ignore[misc]
        case ast.Call(func=ast.Name("shell_command"), args=words):
            return [" ".join(str(word.value) if isinstance(word, ast.Constant) else "X" for word in words)]
        case ast.IfExp(body=first, orelse=second) | ast.BinOp(left=first, right=second):
            return [*texts(first), *texts(second)]
    return []


def test_the_source_has_many_remedies() -> None:
    assert len(remedies()) > 200
    assert sum("fieldkit " in text for _, text in remedies()) > 30


def parser_of(command_line: str, top_parser: Parser) -> tuple[Parser, list[str]]:
    parser, remaining_words = top_parser, command_line.split()
    while remaining_words and (subparser := parser.command(remaining_words[0])):
        parser, remaining_words = subparser, remaining_words[1:]
    return parser, remaining_words


def test_commands_in_remedies_exist_and_accept_their_options() -> None:
    parser = cli.parser()
    invalid_commands = []
    for location, text in remedies():
        for match in COMMAND.finditer(text):
            command, _ = parser_of(match[1], parser)
            if command is parser and match[1].split()[0] not in {"is", "runs", "itself", "reads", "with"}:
                invalid_commands.append((location, match[0], "no such command"))
            accepted_options = set(re.findall(r"--[a-z][a-z-]+", command.format_help()))
            invalid_commands += [
                (location, match[0], option) for option in OPTION.findall(match[2]) if option not in accepted_options
            ]
    assert invalid_commands == []


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("add roles.master, or use --topology master", "add roles.master, or use --fieldkit-topology master"),
        ("fieldkit init, then fill it in; or by --site", "fieldkit init, then fill it in; or by --fieldkit-site"),
        ("fieldkit resume trials/a --backend field", "fieldkit resume trials/a --backend field"),
        ("--storage in record", "--storage in record"),
        ("--fieldkit-yes", "--fieldkit-yes"),
    ],
)
def test_options_in_pytest_messages_have_the_pytest_prefix(message: str, expected: str) -> None:
    assert as_pytest_option(message) == expected


@pytest.mark.parametrize("command_line", ["trial los -5m", "trial los 5m -3ft", "check --record -2s"])
def test_negative_quantity_is_reported_as_below_zero(command_line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command_line.split()) == 2
    assert "is below zero\n  remedy: write for example" in capsys.readouterr().err


def test_documented_command_copies_a_shipped_profile(tmp_path: Path) -> None:
    """The shell creates the empty file before fieldkit searches for the profile."""
    command = f"mkdir -p robots; {shlex.quote(sys.executable)} -m fieldkit robots show husky > robots/husky.yaml"
    subprocess.run(command, shell=True, cwd=tmp_path, check=True)
    copied_profile = (tmp_path / "robots" / "husky.yaml").read_text(encoding="utf-8")
    assert copied_profile == (ROOT / "robots" / "husky.yaml").read_text(encoding="utf-8")


def test_wrong_indentation_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = tmp_path / "lab.yaml"
    site.write_text("robots:\n  a: {profile: husky}\n   b: {profile: husky}\n", encoding="utf-8")
    assert main(["check", "--site", str(site)]) == 2
    message = capsys.readouterr().err
    assert "lab.yaml:3" in message
    assert "indent this line" in message

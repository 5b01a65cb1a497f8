"""Commands in hints and remedies are valid, and include the options of the operator."""

import ast
import json
import re
import shlex
from collections.abc import Iterator

import pytest

from fieldkit.cli import hints, main, parser
from fieldkit.cli.display import show_error, show_findings, showing_events
from fieldkit.cli.event_words import event_words
from fieldkit.core.errors import shell_command
from fieldkit.core.events import Finding, TrialStopped
from fieldkit.core.model import Verdict
from tests.helpers.paths import ROOT

COMMAND = re.compile(r"\bfieldkit(?P<words>(?: [a-z][a-z-]*)+)(?P<rest>[^;,\n`]*)")
OPTIONS = ("--site", "my lab.yaml", "--backend", "field")


def messages() -> Iterator[tuple[str, str, bool]]:
    """Yield the file, each text in the code except docstrings (`x` for values), and whether it is a command."""
    for path in sorted((*ROOT.glob("fieldkit/**/*.py"), *ROOT.glob("sim_backends/**/*.py"))):
        location = str(path.relative_to(ROOT))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        excluded = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                excluded |= {id(part) for part in node.values}
                parts = (part.value if isinstance(part, ast.Constant) else "x" for part in node.values)
                yield location, "".join(map(str, parts)), False
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "typed":
                yield location, shell_command(*(getattr(word, "value", "x") for word in node.args)), True
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in excluded:
                yield location, node.value, False


def test_every_command_in_a_message_exists_and_accepts_its_options() -> None:
    top_parser, n_subcommands = parser(), 0
    for path, text, is_command in messages():
        for match in COMMAND.finditer(text):
            command_parser = top_parser
            for word in match["words"].split():
                command_parser = command_parser.command(word) or command_parser
                command_parser.declare_arguments()
            assert command_parser is not top_parser or not is_command, f"{path}: {text}"
            n_subcommands += command_parser is not top_parser
            options = [] if command_parser is top_parser else re.findall(r" (--[a-z-]+)", match["rest"])
            assert all(command_parser.accepts(option, "x") for option in options), f"{path}: {text}"
    assert n_subcommands > 30


@pytest.mark.parametrize(
    ("typed_command", "hint", "expected"),
    [
        ("check los", "fieldkit abort", "fieldkit abort --site 'my lab.yaml' --backend field"),
        ("check los", "fieldkit enroll a --replace", "fieldkit enroll --site 'my lab.yaml' a --replace"),
        (
            "check los",
            "fieldkit resume t --backend emulated",
            "fieldkit resume --site 'my lab.yaml' t --backend emulated",
        ),
        (
            "trial los 30ft --record 2s --repeats 3",
            "fieldkit check los --topology master",
            "fieldkit check --site 'my lab.yaml' --backend field --repeats 3 --record 2s los --topology master",
        ),
        (
            "trial los 30ft --allow-motion",
            "fieldkit resume t; or fieldkit abort",
            "fieldkit resume --site 'my lab.yaml' --backend field --allow-motion t; or fieldkit abort {given}",
        ),
        ("resume t", "wait, or end it: fieldkit abort; or not", "wait, or end it: fieldkit abort {given}; or not"),
        ("check los", "fieldkit columns lists them", "fieldkit columns lists them"),
        ("check los", "fieldkit init, then fill it in", "fieldkit init, then fill it in"),
        ("lab up", "fieldkit lab down", "fieldkit lab down"),
    ],
)
def test_hints_include_the_options_given(typed_command: str, hint: str, expected: str) -> None:
    top_parser = parser()
    with hints.adding_options(top_parser) as options:
        options.read(top_parser.parse_args((*typed_command.split(), *OPTIONS)))
        hint_with_options = hints.add_options(hint)
    assert hint_with_options == expected.format(given=shlex.join(OPTIONS))
    if hint_with_options.split()[0] == "fieldkit" and not any(
        mark in hint_with_options for mark in (" lists", ",", ";")
    ):
        parsed_hint = top_parser.parse_args(shlex.split(hint_with_options)[1:])
        assert getattr(parsed_hint, "site", None) is None or str(parsed_hint.site) == "my lab.yaml"


def test_every_output_adds_the_options_to_commands(capsys: pytest.CaptureFixture[str]) -> None:
    finding = Finding("a", "lock", Verdict.FAIL, "held", "wait, or end it: fieldkit abort")
    top_parser = parser()
    with hints.adding_options(top_parser) as options:
        options.read(top_parser.parse_args(("check", "--site", "x.yaml")))
        show_error("held\n  remedy: fieldkit abort")
        show_findings([finding])
        for as_json in (False, True):
            with showing_events(as_json=as_json) as sink:
                sink(TrialStopped("my trials/a", 1, 2))
                sink(finding)
    output = capsys.readouterr()
    assert output.err.endswith("remedy: fieldkit abort --site x.yaml\n")
    assert "end it: fieldkit abort --site x.yaml\n" in output.out
    assert "to continue: fieldkit resume --site x.yaml 'my trials/a'\n" in output.out
    assert json.loads(output.out.splitlines()[-1])["remedy"] == "wait, or end it: fieldkit abort --site x.yaml"


def test_without_options_hints_are_unchanged() -> None:
    ((text, _),) = event_words(TrialStopped("trials/a", 1, 2))
    assert hints.add_options(text).endswith("to continue: fieldkit resume trials/a")


@pytest.mark.parametrize(("argv", "usage"), [([], "usage: fieldkit [-h]"), (["lab"], "usage: fieldkit lab [-h]")])
def test_without_a_command_the_help_is_shown(argv: list[str], usage: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 0
    assert capsys.readouterr().out.startswith(usage)

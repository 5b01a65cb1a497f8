"""Commands in hints and remedies: each can be typed as it is shown, with what the operator gave."""

import ast
import json
import re
import shlex
from collections.abc import Iterator

import pytest

from fieldkit.cli import hints, main, parser
from fieldkit.cli.display import show_error, show_findings, watching, words_of
from fieldkit.core.errors import typed
from fieldkit.core.events import Finding, TrialStopped
from fieldkit.core.model import Verdict
from tests.helpers.paths import ROOT

COMMAND = re.compile(r"\bfieldkit(?P<words>(?: [a-z][a-z-]*)+)(?P<rest>[^;,\n`]*)")
GIVEN = ("--site", "my lab.yaml", "--backend", "field")


def named() -> Iterator[tuple[str, str, bool]]:
    """Yield every text of the code that is no docstring, `x` for what is filled in, and whether it is to be typed."""
    for path in sorted((*ROOT.glob("fieldkit/**/*.py"), *ROOT.glob("sim_backends/**/*.py"))):
        where = str(path.relative_to(ROOT))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        apart = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                apart |= {id(part) for part in node.values}
                parts = (part.value if isinstance(part, ast.Constant) else "x" for part in node.values)
                yield where, "".join(map(str, parts)), False
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "typed":
                yield where, typed(*(getattr(one, "value", "x") for one in node.args)), True
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in apart:
                yield where, node.value, False


def test_every_command_that_is_named_is_one_and_takes_its_options() -> None:
    top, seen = parser(), 0
    for path, text, to_type in named():
        for found in COMMAND.finditer(text):
            inner = top
            for word in found["words"].split():
                inner = inner.command(word) or inner
                inner.complete()
            assert inner is not top or not to_type, f"{path}: {text}"
            seen += inner is not top
            options = [] if inner is top else re.findall(r" (--[a-z-]+)", found["rest"])
            assert all(inner.takes(option, "x") for option in options), f"{path}: {text}"
    assert seen > 30


@pytest.mark.parametrize(
    ("typed_before", "hint", "whole"),
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
def test_a_hint_carries_what_was_given(typed_before: str, hint: str, whole: str) -> None:
    top = parser()
    with hints.completing(top) as known:
        known.read(top.parse_args((*typed_before.split(), *GIVEN)))
        completed = hints.completed(hint)
    assert completed == whole.format(given=shlex.join(GIVEN))
    if completed.split()[0] == "fieldkit" and not any(mark in completed for mark in (" lists", ",", ";")):
        again = top.parse_args(shlex.split(completed)[1:])
        assert getattr(again, "site", None) is None or str(again.site) == "my lab.yaml"


def test_every_way_in_which_something_is_shown_completes_it(capsys: pytest.CaptureFixture[str]) -> None:
    finding = Finding("a", "lock", Verdict.FAIL, "held", "wait, or end it: fieldkit abort")
    top = parser()
    with hints.completing(top) as known:
        known.read(top.parse_args(("check", "--site", "x.yaml")))
        show_error("held\n  remedy: fieldkit abort")
        show_findings([finding])
        for as_json in (False, True):
            with watching(as_json=as_json) as sink:
                sink(TrialStopped("my trials/a", 1, 2))
                sink(finding)
    shown = capsys.readouterr()
    assert shown.err.endswith("remedy: fieldkit abort --site x.yaml\n")
    assert "end it: fieldkit abort --site x.yaml\n" in shown.out
    assert "to continue: fieldkit resume --site x.yaml 'my trials/a'\n" in shown.out
    assert json.loads(shown.out.splitlines()[-1])["remedy"] == "wait, or end it: fieldkit abort --site x.yaml"


def test_without_options_a_hint_is_as_it_was_worded() -> None:
    ((text, _),) = words_of(TrialStopped("trials/a", 1, 2))
    assert hints.completed(text).endswith("to continue: fieldkit resume trials/a")


@pytest.mark.parametrize(("words", "begin"), [([], "usage: fieldkit [-h]"), (["lab"], "usage: fieldkit lab [-h]")])
def test_without_a_command_the_help_is_shown(
    words: list[str], begin: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 0
    assert capsys.readouterr().out.startswith(begin)

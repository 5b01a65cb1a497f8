"""Parsing of answers, and answers from a script."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.cli.operators import Script
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Answered, Event, Request
from fieldkit.core.prompts import DONE, Answer, parse


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", DONE),
        ("  \n", DONE),
        ("s\n", Answer(skip=True)),
        ("n wet grass\n", Answer(note="wet grass")),
        ("n", None),
        ("n  ", None),
        ("skip", None),
        ("yes", None),
    ],
)
def test_a_line_is_an_answer_or_none(line: str, expected: Answer | None) -> None:
    assert parse(line, may_skip=True) == expected


def test_skip_is_not_an_answer_if_skipping_is_not_allowed() -> None:
    assert parse("s", may_skip=False) is None


@given(st.text(max_size=20), st.booleans())
def test_an_answer_has_no_note_if_it_skips(line: str, may_skip: bool) -> None:
    answer = parse(line, may_skip=may_skip)
    assert answer is None or not (answer.skip and (answer.note or not may_skip))


def test_a_script_reads_a_line_only_after_its_request_was_reported() -> None:
    events: list[Event] = []

    def lines() -> Iterator[str]:
        yield {"move a": "n windy\n"}[_text(events[-1])]
        yield {"move b": "s\n"}[_text(events[-1])]

    script = Script(lines(), "pipe", events.append)
    assert script.ask("move a", may_skip=True) == Answer(note="windy")
    assert script.ask("move b", may_skip=True) == Answer(skip=True)
    assert events == [
        Request("move a", may_skip=True),
        Answered(skip=False, note="windy"),
        Request("move b", may_skip=True),
        Answered(skip=True, note=""),
    ]


@pytest.mark.parametrize(
    ("line", "message"), [("", "there is no further answer for: move a"), ("what", "'what' is not an answer")]
)
def test_an_error_of_a_script_names_its_line(line: str, message: str) -> None:
    script = Script(iter(["", line] if line else [""]), "answers.txt", lambda event: None)
    script.ask("move z")
    with pytest.raises(ConfigurationError, match=message) as error_info:
        script.ask("move a")
    assert error_info.value.where == "answers.txt:2"
    assert error_info.value.remedy


def _text(event: Event) -> str:
    assert isinstance(event, Request)
    return event.text

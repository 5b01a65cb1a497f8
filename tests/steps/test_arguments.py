"""Variables in arguments: only known names are replaced, and an argument is not split."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.steps import arguments

VALUES = {"distance": "30ft", "repeat": "7", "put": ".put/run/probe"}


def fill_in(word: str) -> str:
    return arguments.fill_in(word, VALUES, lambda role: f"<{role}>")


# The expected results of parts of an argument, written by hand.
PIECES = {
    "{distance}": "30ft",
    "{repeat}": "7",
    "{put}": ".put/run/probe",
    "{address.receiver}": "<receiver>",
    "{{distance}}": "{distance}",
    "{{repeat}}": "{repeat}",
    "{{put}}": "{put}",
    "{{distanse}}": "{distanse}",
    "{{address.receiver}}": "{address.receiver}",
    "${distance}": "${distance}",
    "${repeat:-1}": "${repeat:-1}",
    "{print $1}": "{print $1}",
    "{print}": "{print}",
    "{{.Names}}": "{{.Names}}",
    "{{json .}}": "{{json .}}",
    '{"a": {"b": 1}}': '{"a": {"b": 1}}',
    '{"m": {distance}}': '{"m": 30ft}',
    "[.[] | {name, id}]": "[.[] | {name, id}]",
    "{1..3}": "{1..3}",
    "{}": "{}",
    "{{}}": "{{}}",
    "{": "{",
    "}": "}",
    "$HOME; rm *": "$HOME; rm *",
}


@given(st.lists(st.sampled_from(sorted(PIECES))))
def test_variables_are_replaced_and_other_text_is_unchanged(pieces: list[str]) -> None:
    assert fill_in(" ".join(pieces)) == " ".join(PIECES[piece] for piece in pieces)
    assert arguments.problem(" ".join(pieces), has_program=True) is None


@given(st.text(alphabet="{}$ a.distncerpu", max_size=40))
def test_text_without_variable_is_unchanged(text: str) -> None:
    if not any(f"{name}}}" in text for name in ("distance", "repeat", "put")) and "address." not in text:
        literals = [name for name in ("{{", "}}") if name in text]
        assert literals or fill_in(text) == text


@given(st.text(max_size=30))
def test_values_are_not_expanded_again(value: str) -> None:
    word = arguments.fill_in("a{distance}b{repeat}", {"distance": value, "repeat": "{distance}"}, str)
    assert word == f"a{value}b{{distance}}"


@pytest.mark.parametrize(
    ("word", "suggested"),
    [
        ("{distanse}", "{distance}"),
        ("{Distance}", "{distance}"),
        ("{ distance }", "{distance}"),
        ("{distance_m}", "{distance}"),
        ("{dist}", "{distance}"),
        ("{repeats}", "{repeat}"),
        ("{REPEAT}", "{repeat}"),
        ("{Put}", "{put}"),
        ("{adress.receiver}", "{address.receiver}"),
    ],
)
def test_misspelled_variable_is_rejected_with_suggestion(word: str, suggested: str) -> None:
    reason = arguments.problem(f"--x={word}", has_program=True)
    assert reason is not None
    assert f"there is no variable {word}; did you mean '{suggested}'? write {{{word}}} for the text {word}" == reason
    assert fill_in(f"{{{word}}}") == word, "the remedy is effective"


def test_put_without_copied_program_is_rejected() -> None:
    assert "the step has no put:" in (arguments.problem("{put}", has_program=False) or "")
    assert arguments.problem("{{put}}", has_program=False) is None

"""Variables in arguments: only theirs are replaced, and one argument stays one, whatever it holds."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.steps import arguments

VALUES = {"distance": "30ft", "repeat": "7", "put": ".put/run/probe"}


def filled(word: str) -> str:
    return arguments.filled(word, VALUES, lambda role: f"<{role}>")


# What each piece of an argument becomes, written down by hand.
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
def test_each_piece_becomes_what_it_stands_for_and_nothing_else(pieces: list[str]) -> None:
    assert filled(" ".join(pieces)) == " ".join(PIECES[piece] for piece in pieces)
    assert arguments.problem(" ".join(pieces), has_program=True) is None


@given(st.text(alphabet="{}$ a.distncerpu", max_size=40))
def test_a_text_without_a_variable_stays_as_it_is(text: str) -> None:
    if not any(f"{name}}}" in text for name in ("distance", "repeat", "put")) and "address." not in text:
        literals = [name for name in ("{{", "}}") if name in text]
        assert literals or filled(text) == text


@given(st.text(max_size=30))
def test_a_value_is_not_looked_at_again(value: str) -> None:
    word = arguments.filled("a{distance}b{repeat}", {"distance": value, "repeat": "{distance}"}, str)
    assert word == f"a{value}b{{distance}}"


@pytest.mark.parametrize(
    ("word", "meant"),
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
def test_what_is_almost_a_variable_is_refused_with_the_nearest_name(word: str, meant: str) -> None:
    why = arguments.problem(f"--x={word}", has_program=True)
    assert why is not None
    assert f"there is no variable {word}; did you mean '{meant}'? write {{{word}}} for the text {word}" == why
    assert filled(f"{{{word}}}") == word, "the remedy works when it is typed"


def test_the_path_of_a_program_that_is_not_copied_is_refused() -> None:
    assert "the step has no put:" in (arguments.problem("{put}", has_program=False) or "")
    assert arguments.problem("{{put}}", has_program=False) is None

"""Sanitizing of text of unknown origin in all output formats."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.text import escape_formula, json_text, one_line, sanitized, unescape_formula


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("plain 1.5\N{NO-BREAK SPACE}ms\nÄ 字", "plain 1.5\N{NO-BREAK SPACE}ms\nÄ 字"),
        ("a\x1b[31mb", "a?[31mb"),
        ("\u202eabc", "?abc"),
        ("\ud800", "?"),
        ("\a\r", "??"),
    ],
)
def test_terminal_control_characters_are_replaced(text: str, expected: str) -> None:
    assert sanitized(text) == expected


def is_printable(text: str) -> bool:
    return all(char.isprintable() or char in "\n\N{NO-BREAK SPACE}" for char in text)


@given(st.text())
def test_any_text_is_printable_in_every_form(text: str) -> None:
    assert is_printable(sanitized(text))
    assert is_printable(json_text({"a": text}))
    assert is_printable(one_line(text))
    assert "\n" not in one_line(text)
    assert sanitized(sanitized(text)) == sanitized(text)


@given(st.text().filter(str.isprintable))
def test_a_printable_text_is_unchanged(text: str) -> None:
    assert sanitized(text) == one_line(text) == text


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(JSON, st.sampled_from([None, 1]))
def test_escaped_json_has_the_same_value(value: object, indent: int | None) -> None:
    assert json.loads(json_text(value, indent=indent)) == value


def test_json_escapes_all_unprintable_characters() -> None:
    assert json_text("\x7f\x9b\u202e\U000e0001\xa0é") == '"\\u007f\\u009b\\u202e\\udb40\\udc01\xa0é"'


CELLS = st.text() | st.from_regex(r"'{0,2}[=+@-][0-9a-z|!'\"]{0,5}", fullmatch=True)


@given(CELLS)
def test_an_escaped_cell_is_not_a_formula_and_can_be_restored(text: str) -> None:
    cell = escape_formula(text)
    assert unescape_formula(cell) == text
    if cell[:1] in {"=", "+", "-", "@"} and len(cell) > 1:
        float(cell)  # a number


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("=cmd|'/c calc'!A0", "'=cmd|'/c calc'!A0"),
        ("@SUM(1)", "'@SUM(1)"),
        ("-52.7", "-52.7"),
        ("-52.7 dBm", "'-52.7 dBm"),
        ("+1e3", "+1e3"),
        ("'=x", "''=x"),
        ("-", "-"),
        ("it's", "it's"),
    ],
)
def test_a_possible_formula_is_marked_as_text(text: str, cell: str) -> None:
    assert escape_formula(text) == cell

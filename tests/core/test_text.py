import pytest

from fieldkit.core.text import harmless


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain 1.5\N{NO-BREAK SPACE}ms\nÄ 字", "plain 1.5\N{NO-BREAK SPACE}ms\nÄ 字"),
        ("a\x1b[31mb", "a?[31mb"),
        ("\u202eabc", "?abc"),
        ("\ud800", "?"),
        ("\a\r", "??"),
    ],
)
def test_nothing_is_left_that_a_terminal_obeys(text: str, shown: str) -> None:
    assert harmless(text) == shown

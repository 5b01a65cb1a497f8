"""Untrusted text in Markdown, as rendered by GitHub."""

import pytest

from fieldkit.analysis.paper_tables import markdown_escaped, markdown_line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30ft, p < 0.001: 1.2 % [0.4, 2.0] in rtt_median_s", "30ft, p < 0.001: 1.2 % [0.4, 2.0] in rtt_median_s"),
        ("a|b", r"a\|b"),
        ("a\\|b", r"a\\\|b"),
        ("<img src=x onerror=alert(1)>", r"\<img src=x onerror=alert(1)>"),
        ("<!-- the rest", r"\<!-- the rest"),
        ("[here](https://example.org)", r"[here]\(https://example.org)"),
        ("[here]: https://example.org", r"[here]\: https://example.org"),
        ("`rm`, **all**", r"\`rm\`, \*\*all\*\*"),
        ("two\r\nlines", "two lines"),
    ],
)
def test_untrusted_text_is_not_markup(text: str, expected: str) -> None:
    assert markdown_escaped(text) == expected
    assert markdown_line([text, "x"]) == f"| {expected} | x |\n"

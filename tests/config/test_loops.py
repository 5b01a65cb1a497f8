"""Expansion of `for:` in procedures, with the source lines of the result."""

import itertools
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config import loops, schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.trial.procedure import Procedure
from tests.helpers.plans import steps_of

HEAD = "name: x\nsummary: x\nscenario: los\ntopology: master\nprotocols: [udp]\nrepeats: 1\nsteps:\n"
SWEEP = """\
  - for:
      each: {bytes: [502, 1400, 8192]}
      during:
        - ping: {name: "p{bytes}", from: sender, to: receiver, payload_bytes: "{bytes}"}
"""


def document(steps: str) -> schema.Document:
    return schema.parse(HEAD + steps, source="x.yaml")


def load(steps: str) -> Procedure:
    return schema.validate(document(steps), Procedure)


def error_of(steps: str) -> tuple[str, int, str]:
    """Return the error message of a procedure, its line after the header, and the remedy."""
    with pytest.raises(ConfigurationError) as error_info:
        load(steps)
    return (
        error_info.value.what,
        int(error_info.value.where.removeprefix("x.yaml:")) - HEAD.count("\n"),
        error_info.value.remedy,
    )


def test_step_is_expanded_for_each_value_with_its_type() -> None:
    pings = list(steps_of(load(SWEEP), PingStep))
    assert [(ping.name, ping.payload_bytes.tcp, ping.payload_bytes.udp) for ping in pings] == [
        ("p502", 502, 502),
        ("p1400", 1400, 1400),
        ("p8192", 8192, 8192),
    ]


def test_all_combinations_are_expanded_with_the_last_variable_fastest() -> None:
    expanded = loops.expand_loops(
        document('  - for: {each: {a: [1, 2], b: [x, y]}, during: [one: {is: "{a}-{b}"}, two: {}]}'), "steps"
    )
    assert [step.get("one", {}).get("is") for step in expanded.data["steps"]] == [
        "1-x", None, "1-y", None, "2-x", None, "2-y", None
    ]  # fmt: skip


def test_nested_loops_use_the_values_of_enclosing_loops() -> None:
    expanded = loops.expand_loops(
        document(
            """\
  - for:
      each: {size: [2MB, 5MB]}
      during:
        - capture:
            name: "c{size}"
            during:
              - for: {each: {word: ["{size}", b]}, during: [run: {say: ["{word}", "{{word}} {x of {size}"]}]}
  - other: {kept: "{as} {{it}} is", during: [{for: {each: {n: [true]}, during: [a: {b: "{n}", c: "n{n}"}]}}]}
"""
        ),
        "steps",
    )
    assert expanded.data["steps"] == [
        {
            "capture": {
                "name": f"c{size}",
                "during": [{"run": {"say": [word, f"{{word}} {{x of {size}"]}} for word in (size, "b")],
            }
        }
        for size in ("2MB", "5MB")
    ] + [{"other": {"kept": "{as} {{it}} is", "during": [{"a": {"b": True, "c": "ntrue"}}]}}]


def test_file_without_loops_is_unchanged() -> None:
    before = document("  - a: {b: 1}\n  - c:\n      during:\n        - move:\n            during: [a: {b: 1}]\n")
    assert loops.expand_loops(before, "steps") == before


@pytest.mark.parametrize(
    ("old", "new", "message", "line", "remedy"),
    [
        ('"p{bytes}"', '"p{size}"', "there is no variable size; the variables are: bytes", 4, "write {{size}} for"),
        ('"p{bytes}"', '"p{byte}"', "there is no variable byte; did you mean 'bytes'?", 4, "or use a variable"),
        ('"{bytes}"}', "{bytes}}", "without quotes YAML reads {bytes} as a map", 4, 'put it in quotes: "{bytes}"'),
        ("[502, 1400, 8192]", "502", "the values of bytes are not a list", 2, "bytes: [1, 2]"),
        ("[502, 1400, 8192]", "[]", "the values of bytes are not a list", 2, "bytes: [1, 2]"),
        ("[502, 1400, 8192]", "[[502]]", "a value of bytes is not a text or a number", 2, "bytes: [1, 2]"),
        ("{bytes: [502, 1400, 8192]}", "[502]", "each: of for: has no variable", 2, "each: {bytes: [502, 1400]}"),
        ("{bytes: [", "{Bytes: [", "'Bytes' is not a valid variable", 2, "lower-case letters"),
        ("each:", "eech:", "unknown key eech in for:", 2, "for: {each:"),
        ("      each: {bytes: [502, 1400, 8192]}\n", "", "for: needs each: and during:", 1, "for: {each:"),
        ("      during:\n", "      during: 5\n      due:\n", "unknown key due in for:", 4, "for: {each:"),
        ("  - for:", "  - fore:", "unknown key fore", 1, "correct this line"),
        ("  - for:", "  - ping: {}\n    for:", "for: must be the only key of its entry", 1, "- for:"),
        ('name: "p{bytes}", ', "", "a ping is defined twice; give each of them another name. In a loop", 4, ""),
        ('"p{bytes}"', "p", "a ping named p is defined twice; rename one of them", 4, ""),
        ('"{bytes}"}', '"{bytes}", cuont: 3}', "unknown key cuont; did you mean 'count'?", 4, ""),
        ("8192]", "99999]", "Input should be less than or equal to 65507", 4, ""),
    ],
)  # fmt: skip
def test_error_in_a_loop_has_its_line_and_a_remedy(old: str, new: str, message: str, line: int, remedy: str) -> None:
    assert old in SWEEP
    error = error_of(SWEEP.replace(old, new))
    assert message in error[0]
    assert error[1] == line
    assert remedy in error[2]


def test_variable_of_an_enclosing_loop_cannot_be_reused() -> None:
    nested_loop = SWEEP.replace("- ping", "- for: {each: {bytes: [1]}, during: [ping").replace('"}', '"}]}')
    assert error_of(nested_loop)[:2] == ("bytes is a variable of an enclosing for:", 4)


def test_number_of_steps_is_limited() -> None:
    values = ", ".join(map(str, range(32)))
    two_variables = f"{{each: {{a: [{values}], b: [{values}]}}, during: [a: {{}}]}}"
    assert error_of(f"  - for: {two_variables}")[:2] == ("for: has 1024 combinations, more than 1000", 1)
    nested_loops = f"{{each: {{a: [{values}]}}, during: [for: {{each: {{b: [{values}]}}, during: [a: {{}}]}}]}}"
    assert error_of(f"  - for: {nested_loops}")[:2] == ("there are more than 1000 steps after for: is expanded", 1)


SCALARS = st.one_of(st.integers(-9, 9), st.booleans(), st.text("abc", min_size=1, max_size=3))


@given(
    values_by_variable=st.dictionaries(
        st.text("abc", min_size=1, max_size=2), st.lists(SCALARS, min_size=1, max_size=3), min_size=1, max_size=3
    )
)
def test_order_equals_itertools_product_and_steps_have_the_line_of_the_loop_body(
    values_by_variable: dict[str, list[Any]],
) -> None:
    step = {"step": {name: f"{{{name}}}" for name in values_by_variable}}
    before = schema.Document(
        {"steps": [{"for": {"each": values_by_variable, "during": [step]}}, step]},
        "x.yaml",
        {(): 1, ("steps",): 1, ("steps", 0, "for", "during", 0): 7, ("steps", 1): 9},
    )
    after = loops.expand_loops(before, "steps")
    combinations = [
        dict(zip(values_by_variable, combination, strict=True))
        for combination in itertools.product(*values_by_variable.values())
    ]
    assert after.data["steps"] == [*({"step": values} for values in combinations), step]
    assert [after.lines["steps", index] for index in range(len(combinations) + 1)] == [7] * len(combinations) + [9]

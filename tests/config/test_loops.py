"""`for:` in procedures: what it is written out to, with the lines that everything came from."""

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


def loaded(steps: str) -> Procedure:
    return schema.validate(document(steps), Procedure)


def refused(steps: str) -> tuple[str, int, str]:
    """Return what is wrong with a procedure, in which of its lines behind the head, and the remedy."""
    with pytest.raises(ConfigurationError) as caught:
        loaded(steps)
    return caught.value.what, int(caught.value.where.removeprefix("x.yaml:")) - HEAD.count("\n"), caught.value.remedy


def test_a_step_is_written_out_once_for_each_value_which_keeps_its_type() -> None:
    pings = list(steps_of(loaded(SWEEP), PingStep))
    assert [(one.name, one.payload_bytes.tcp, one.payload_bytes.udp) for one in pings] == [
        ("p502", 502, 502),
        ("p1400", 1400, 1400),
        ("p8192", 8192, 8192),
    ]


def test_every_combination_is_written_out_the_last_variable_changing_fastest() -> None:
    found = loops.written_out(
        document('  - for: {each: {a: [1, 2], b: [x, y]}, during: [one: {is: "{a}-{b}"}, two: {}]}'), "steps"
    )
    assert [one.get("one", {}).get("is") for one in found.data["steps"]] == [
        "1-x", None, "1-y", None, "2-x", None, "2-y", None
    ]  # fmt: skip


def test_loops_stand_in_each_other_and_in_other_steps_and_use_the_values_of_those_around() -> None:
    found = loops.written_out(
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
    assert found.data["steps"] == [
        {
            "capture": {
                "name": f"c{size}",
                "during": [{"run": {"say": [word, f"{{word}} {{x of {size}"]}} for word in (size, "b")],
            }
        }
        for size in ("2MB", "5MB")
    ] + [{"other": {"kept": "{as} {{it}} is", "during": [{"a": {"b": True, "c": "ntrue"}}]}}]


def test_a_file_without_loops_stays_as_it_is() -> None:
    before = document("  - a: {b: 1}\n  - c:\n      during:\n        - move:\n            during: [a: {b: 1}]\n")
    assert loops.written_out(before, "steps") == before


@pytest.mark.parametrize(
    ("old", "new", "what", "line", "remedy"),
    [
        ('"p{bytes}"', '"p{size}"', "there is no variable size; here are: bytes", 4, "write {{size}} for"),
        ('"p{bytes}"', '"p{byte}"', "there is no variable byte; did you mean 'bytes'?", 4, "or name a variable"),
        ('"{bytes}"}', "{bytes}}", "without quotes YAML takes {bytes} for a map", 4, 'put it in quotes: "{bytes}"'),
        ("[502, 1400, 8192]", "502", "the values of bytes are no list", 2, "bytes: [1, 2]"),
        ("[502, 1400, 8192]", "[]", "the values of bytes are no list", 2, "bytes: [1, 2]"),
        ("[502, 1400, 8192]", "[[502]]", "a value of bytes is no text or number", 2, "bytes: [1, 2]"),
        ("{bytes: [502, 1400, 8192]}", "[502]", "each: of for: names no variable", 2, "each: {bytes: [502, 1400]}"),
        ("{bytes: [", "{Bytes: [", "'Bytes' cannot be a variable", 2, "small letters"),
        ("each:", "eech:", "unknown key eech in for:", 2, "for: {each:"),
        ("      each: {bytes: [502, 1400, 8192]}\n", "", "for: needs each: and during:", 1, "for: {each:"),
        ("      during:\n", "      during: 5\n      due:\n", "unknown key due in for:", 4, "for: {each:"),
        ("  - for:", "  - fore:", "unknown key fore", 1, "mend this line"),
        ("  - for:", "  - ping: {}\n    for:", "for: stands alone in its entry", 1, "- for:"),
        ('name: "p{bytes}", ', "", "a ping comes twice; give each a name:, inside for:", 4, ""),
        ('"p{bytes}"', "p", "a ping named p comes twice; give one another name, inside for:", 4, ""),
        ('"{bytes}"}', '"{bytes}", cuont: 3}', "unknown key cuont; did you mean 'count'?", 4, ""),
        ("8192]", "99999]", "Input should be less than or equal to 65507", 4, ""),
    ],
)  # fmt: skip
def test_what_is_wrong_names_its_line_and_a_remedy(old: str, new: str, what: str, line: int, remedy: str) -> None:
    assert old in SWEEP
    said = refused(SWEEP.replace(old, new))
    assert what in said[0]
    assert said[1] == line
    assert remedy in said[2]


def test_a_variable_is_not_hidden_by_a_loop_inside() -> None:
    inner = SWEEP.replace("- ping", "- for: {each: {bytes: [1]}, during: [ping").replace('"}', '"}]}')
    assert refused(inner)[:2] == ("bytes is a variable of a for: around this one", 4)


def test_steps_are_bounded() -> None:
    values = ", ".join(map(str, range(32)))
    twice = f"{{each: {{a: [{values}], b: [{values}]}}, during: [a: {{}}]}}"
    assert refused(f"  - for: {twice}")[:2] == ("for: has 1024 combinations, more than 1000", 1)
    nested = f"{{each: {{a: [{values}]}}, during: [for: {{each: {{b: [{values}]}}, during: [a: {{}}]}}]}}"
    assert refused(f"  - for: {nested}")[:2] == ("there are more than 1000 steps, all for: written out", 1)


SCALARS = st.one_of(st.integers(-9, 9), st.booleans(), st.text("abc", min_size=1, max_size=3))


@given(
    each=st.dictionaries(
        st.text("abc", min_size=1, max_size=2), st.lists(SCALARS, min_size=1, max_size=3), min_size=1, max_size=3
    )
)
def test_values_come_in_the_order_of_itertools_with_the_line_of_the_loop(each: dict[str, list[Any]]) -> None:
    step = {"step": {name: f"{{{name}}}" for name in each}}
    before = schema.Document(
        {"steps": [{"for": {"each": each, "during": [step]}}, step]},
        "x.yaml",
        {(): 1, ("steps",): 1, ("steps", 0, "for", "during", 0): 7, ("steps", 1): 9},
    )
    after = loops.written_out(before, "steps")
    combinations = [dict(zip(each, chosen, strict=True)) for chosen in itertools.product(*each.values())]
    assert after.data["steps"] == [*({"step": one} for one in combinations), step]
    assert [after.lines["steps", index] for index in range(len(combinations) + 1)] == [7] * len(combinations) + [9]

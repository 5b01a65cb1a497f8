"""Filters of rows, compared with an interpreter of three-valued logic, and their errors."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis.row_filters import parse_filter
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial.columns import trial_columns
from tests.helpers.runs import run_here
from tests.helpers.tables import COMPARABLE, parsed, replace, write

COLUMNS = {column.name: column for column in trial_columns()}
ROWS: list[dict[str, Any]] = [
    {
        "protocol": protocol,
        "distance_m": distance_m,
        "hash_match": matches,
        "topology": "master",
        "rtt_median_s": rtt_s,
    }
    for protocol in ("tcp", "udp")
    for distance_m in (5.0, 20.0, None)
    for matches in (True, False, None)
    for rtt_s in (None, 20.0)
]

LEAVES: dict[str, Any] = {
    "distance_m < 20": lambda row: None if row["distance_m"] is None else row["distance_m"] < 20,
    "5 <= distance_m <= 10": lambda row: None if row["distance_m"] is None else 5 <= row["distance_m"] <= 10,
    "distance_m != 5": lambda row: None if row["distance_m"] is None else row["distance_m"] != 5,
    "-1 < distance_m": lambda row: None if row["distance_m"] is None else True,
    "distance_m == rtt_median_s": lambda row: (
        None if None in {row["distance_m"], row["rtt_median_s"]} else row["distance_m"] == row["rtt_median_s"]
    ),
    "distance_m in [5, 7]": lambda row: None if row["distance_m"] is None else row["distance_m"] in {5, 7},
    "distance_m not in (5, 7)": lambda row: None if row["distance_m"] is None else row["distance_m"] not in {5, 7},
    'protocol == "udp"': lambda row: row["protocol"] == "udp",
    "protocol in ['tcp', 'x']": lambda row: row["protocol"] == "tcp",
    "relay == 'drone'": lambda row: None,
    "hash_match": lambda row: row["hash_match"],
    "hash_match == false": lambda row: None if row["hash_match"] is None else not row["hash_match"],
}


def negate(value: bool | None) -> bool | None:
    return None if value is None else not value


def combine(kind: str, values: list[bool | None]) -> bool | None:
    decisive = kind == "or"
    if decisive in values:
        return decisive
    return None if None in values else not decisive


CONDITIONS = st.recursive(
    st.sampled_from(sorted(LEAVES)).map(lambda text: (text, LEAVES[text])),
    lambda children: st.one_of(
        children.map(lambda child: (f"not ({child[0]})", lambda row: negate(child[1](row)))),
        st.tuples(st.sampled_from(["and", "or"]), st.lists(children, min_size=2, max_size=3)).map(
            lambda pair: (
                f" {pair[0]} ".join(f"({text})" for text, _ in pair[1]),
                lambda row: combine(pair[0], [decide(row) for _, decide in pair[1]]),
            )
        ),
    ),
    max_leaves=6,
)


@given(CONDITIONS)
def test_a_filter_chooses_the_rows_for_which_it_is_true(condition: tuple[str, Any]) -> None:
    text, decide = condition
    mask = parse_filter(text, COLUMNS).mask(parsed(ROWS))
    assert mask.tolist() == [decide(row) is True for row in ROWS], text


@given(st.text(max_size=40) | st.text(st.sampled_from("()[]{}'\"<>=!.,+-*~ \n\0abnotrdi019_m:"), max_size=40))
def test_any_text_is_a_condition_or_a_configuration_error(text: str) -> None:
    with suppress(ConfigurationError):
        mask = parse_filter(text, COLUMNS).mask(parsed(ROWS[:2]))
        assert mask.dtype == np.bool_
        assert mask.shape == (2,)


@pytest.mark.parametrize(
    ("text", "message", "remedy"),
    [
        ("distnce_m < 20", "there is no column 'distnce_m'", "did you mean 'distance_m'?"),
        ("topology == master", "there is no column 'master'", "a text needs quotes"),
        ("topology < 'x'", "texts have no order", "use =="),
        ("distance_m == '20'", "compares a text with a number", "quotes"),
        ("distance_m", "'distance_m' is not a comparison", "write for example"),
        ("distance_m < ", "is not an expression: invalid syntax", "write for example"),
        ("__import__('os').system('true') == 0", "is not a comparison of columns", "write for example"),
        ("distance_m + 1 < 20", "'distance_m + 1' is not a comparison of columns", "write for example"),
        ("(" * 500 + "distance_m < 1" + ")" * 500, "is not an expression", "write for example"),
    ],
)
def test_an_invalid_expression_is_refused(text: str, message: str, remedy: str) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        parse_filter(text, COLUMNS)
    assert message in error_info.value.what
    assert remedy in error_info.value.remedy


def test_an_integer_beyond_floats_is_infinite() -> None:
    rows = parsed(ROWS[:2])
    for text, expected in (
        ("distance_m < 1" + "0" * 400, True),
        ("distance_m > -1" + "0" * 400, True),
        ("distance_m in [1" + "0" * 400 + "]", False),
    ):
        assert parse_filter(text, COLUMNS).mask(rows).tolist() == [expected] * 2, text


def test_commands_use_only_the_chosen_rows(tmp_path: Path) -> None:
    rows = [
        replace(COMPARABLE, repeat=number, distance=f"{5 * number}m", distance_m=5.0 * number) for number in (1, 2, 3)
    ]
    write(tmp_path / "trial", rows)
    filtered = run_here(
        tmp_path, "aggregate", "trial", "--where", "distance_m > 5", "--format", "csv", "--by", "distance"
    )
    assert filtered.code == 0, filtered.err
    assert {line.split(",")[0] for line in filtered.out.splitlines()[1:]} == {"10m", "15m"}
    no_rows = run_here(tmp_path, "aggregate", "trial", "--where", "distance_m > 50")
    assert no_rows.code == 4
    assert "none of 3 attempts satisfies --where distance_m > 50" in no_rows.err

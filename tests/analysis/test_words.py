"""Word counts of a text column per condition, in all table formats and without statistical inference."""

import csv
import io
from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import comparison_results, paper_tables, repeats, result_tables, wording
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.compare import compare
from fieldkit.analysis.repeats import Repeats
from fieldkit.core.columns import Column, Figure, Kind, csv_text
from fieldkit.trial.columns import trial_columns
from tests.helpers.tables import COMPARABLE, replace

GRASS = Column("grass", "text", "The state of the grass.", figure=Figure("the grass", Kind.WORDS))
PLAIN = Column("plain", "text", "Words that are not counted.")
COLUMNS = (*trial_columns(), GRASS, PLAIN)


def table(words: Sequence[str], protocols: Sequence[str] = ("udp",), status: str = "valid") -> Repeats:
    """Return repeats with one word each and alternating protocols. The column `plain` is not counted."""
    result = [
        {
            **replace(COMPARABLE, repeat=1 + number, protocol=protocols[number % len(protocols)], status=status),
            "grass": word,
            "plain": word[::-1],
        }
        for number, word in enumerate(words)
    ]
    names = [column.name for column in COLUMNS]
    return repeats.parse(csv_text(names, ([row.get(name) for name in names] for row in result)).encode(), COLUMNS)


def cell(*words: str) -> Cell:
    (result,) = aggregate(table(words))
    return result


@given(st.lists(st.tuples(st.sampled_from(("tcp", "udp")), st.sampled_from(("", "wet", "dry", "a=b"))), min_size=1))
def test_each_word_is_counted_in_its_condition(words_by_protocol: list[tuple[str, str]]) -> None:
    expected = {
        protocol: Counter(word for row, word in words_by_protocol if row == protocol and word)
        for protocol, _ in words_by_protocol
    }
    names = [column.name for column in COLUMNS]
    rows = [
        {**replace(COMPARABLE, repeat=1 + number, protocol=protocol), "grass": word}
        for number, (protocol, word) in enumerate(words_by_protocol)
    ]
    text = csv_text(names, ([row.get(name) for name in names] for row in rows))
    for row in aggregate(repeats.parse(text.encode(), COLUMNS)):
        tally = row.tallies.get("grass")
        expected_counts = expected[str(row.key["protocol"])]
        assert (tally is None) == (not expected_counts)
        if tally is not None:
            assert list(tally.counts.items()) == sorted(expected_counts.items(), key=lambda pair: (-pair[1], pair[0]))
            assert tally.n == expected_counts.total()


def test_only_valid_repeats_and_declared_columns_are_counted() -> None:
    assert aggregate(table(["wet", "dry"], status="void"))[0].tallies == {}
    assert set(cell("wet").tallies) == {"grass"}


def test_a_table_has_a_row_per_word_without_an_interval() -> None:
    (result,) = aggregate(table(["wet", "dry", "wet", ""]), ("protocol",), quantities=())
    rows = list(csv.DictReader(io.StringIO(result_tables.to_csv(("protocol",), [result]))))
    assert [(row["quantity"], row["estimate"], row["n"], row["events"]) for row in rows] == [
        ("grass=wet", "words", "3", "2"),
        ("grass=dry", "words", "3", "1"),
    ]
    assert [float(row["value"]) for row in rows] == pytest.approx([2 / 3, 1 / 3])
    assert {row["low"] + row["high"] + row["wilson_low"] for row in rows} == {""}
    assert "| the grass |\n" in paper_tables.to_markdown(("protocol",), [result], ())
    assert "| wet 2, dry 1, 1 without |\n" in paper_tables.to_markdown(("protocol",), [result], ())


@pytest.mark.parametrize(
    ("words", "expected_text"),
    [
        (("wet", "dry", "dry"), "dry 2, wet 1"),
        (("wet", "", ""), "wet 1, 2 without"),
        (("1.2.3", "a, b 2"), "'1.2.3' 1, 'a, b 2' 1"),
        (("x" * 40,), f"'{'x' * 30}...' 1"),
        (("a", "b", "c", "d", "e", "f"), "a 1, b 1, c 1, d 1, e 1, f 1"),
        (("a", "a", "b", "c", "d", "e", "f", "g"), "a 2, b 1, c 1, d 1, e 1, 2 others 2"),
    ],
)
def test_the_most_frequent_words_are_listed(words: tuple[str, ...], expected_text: str) -> None:
    assert wording.tally(cell(*words), "grass") == expected_text


def test_words_of_two_runs_are_listed_but_not_compared() -> None:
    a, b = table(["wet", "wet", "dry"]), table(["dry", "dry", ""])
    result = compare(a, b)
    without_words = compare(table(["", "", ""]), table(["", "", ""]))
    assert result.n_compared == without_words.n_compared, "words do not count as comparisons"
    rows = {row.quantity: row for _, row in comparison_results.difference_rows(result) if row.estimate == Kind.WORDS}
    assert set(rows) == {"grass=wet", "grass=dry"}
    wet = rows["grass=wet"]
    assert (wet.n_a, wet.n_b) == (3, 2)
    assert (wet.a, wet.b, wet.difference) == (2 / 3, 0.0, -2 / 3)
    assert (wet.low, wet.high, wet.p_holm, wet.cliffs_delta) == (None, None, None, None)


def test_words_of_only_one_run_are_listed() -> None:
    rows = [row for _, row in comparison_results.difference_rows(compare(table(["", ""]), table(["wet", ""])))]
    (wet,) = (row for row in rows if row.quantity == "grass=wet")
    assert (wet.n_a, wet.n_b, wet.a, wet.b, wet.difference) == (None, 1, None, 1, None)

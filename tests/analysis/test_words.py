"""Words of a text column: counted per condition, shown in every table, never judged."""

import csv
import io
from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import repeats, tables, wording
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.compare import compare
from fieldkit.analysis.repeats import Repeats
from fieldkit.core.columns import Column, Figure, Kind, csv_text
from fieldkit.trial.columns import trial_columns
from tests.helpers.tables import COMPARABLE, replace

GRASS = Column("grass", "text", "How it is.", figure=Figure("the grass", Kind.WORDS))
PLAIN = Column("plain", "text", "Words that nobody counts.")
COLUMNS = (*trial_columns(), GRASS, PLAIN)


def table(words: Sequence[str], protocols: Sequence[str] = ("udp",), status: str = "valid") -> Repeats:
    """Repeats with a word each, protocols in turn; the words that nobody counts are their opposites."""
    found = [
        {
            **replace(COMPARABLE, repeat=1 + number, protocol=protocols[number % len(protocols)], status=status),
            "grass": word,
            "plain": word[::-1],
        }
        for number, word in enumerate(words)
    ]
    names = [column.name for column in COLUMNS]
    return repeats.parse(csv_text(names, ([one.get(name) for name in names] for one in found)).encode(), COLUMNS)


def cell(*words: str) -> Cell:
    (found,) = aggregate(table(words))
    return found


@given(st.lists(st.tuples(st.sampled_from(("tcp", "udp")), st.sampled_from(("", "wet", "dry", "a=b"))), min_size=1))
def test_each_word_is_counted_under_its_own_condition(given_: list[tuple[str, str]]) -> None:
    expected = {protocol: Counter(word for one, word in given_ if one == protocol and word) for protocol, _ in given_}
    names = [column.name for column in COLUMNS]
    rows_of = [
        {**replace(COMPARABLE, repeat=1 + number, protocol=protocol), "grass": word}
        for number, (protocol, word) in enumerate(given_)
    ]
    text = csv_text(names, ([one.get(name) for name in names] for one in rows_of))
    for one in aggregate(repeats.parse(text.encode(), COLUMNS)):
        tally = one.tallies.get("grass")
        counted = expected[str(one.key["protocol"])]
        assert (tally is None) == (not counted)
        if tally is not None:
            assert list(tally.counts.items()) == sorted(counted.items(), key=lambda pair: (-pair[1], pair[0]))
            assert tally.n == counted.total()


def test_only_valid_repeats_count_and_only_words_that_are_declared() -> None:
    assert aggregate(table(["wet", "dry"], status="void"))[0].tallies == {}
    assert set(cell("wet").tallies) == {"grass"}


def test_a_table_has_a_row_per_word_without_an_interval() -> None:
    (found,) = aggregate(table(["wet", "dry", "wet", ""]), ("protocol",), quantities=())
    rows = list(csv.DictReader(io.StringIO(tables.to_csv(("protocol",), [found]))))
    assert [(one["quantity"], one["estimate"], one["n"], one["events"]) for one in rows] == [
        ("grass=wet", "words", "3", "2"),
        ("grass=dry", "words", "3", "1"),
    ]
    assert [float(one["value"]) for one in rows] == pytest.approx([2 / 3, 1 / 3])
    assert {one["low"] + one["high"] + one["wilson_low"] for one in rows} == {""}
    assert "| the grass |\n" in tables.to_markdown(("protocol",), [found], ())
    assert "| wet 2, dry 1, 1 without |\n" in tables.to_markdown(("protocol",), [found], ())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("wet", "dry", "dry"), "dry 2, wet 1"),
        (("wet", "", ""), "wet 1, 2 without"),
        (("1.2.3", "a, b 2"), "'1.2.3' 1, 'a, b 2' 1"),
        (("x" * 40,), f"'{'x' * 30}...' 1"),
        (("a", "b", "c", "d", "e", "f"), "a 1, b 1, c 1, d 1, e 1, f 1"),
        (("a", "a", "b", "c", "d", "e", "f", "g"), "a 2, b 1, c 1, d 1, e 1, 2 others 2"),
    ],
)
def test_people_read_the_most_frequent_words(words: tuple[str, ...], said: str) -> None:
    assert wording.tally(cell(*words), "grass") == said


def test_words_of_two_runs_stand_side_by_side_and_are_no_comparison() -> None:
    a, b = table(["wet", "wet", "dry"]), table(["dry", "dry", ""])
    found = compare(a, b)
    without = compare(table(["", "", ""]), table(["", "", ""]))
    assert found.made == without.made, "words are no part of what chance is corrected for"
    rows = {row.quantity: row for _, row in tables.difference_rows(found) if row.estimate == Kind.WORDS}
    assert set(rows) == {"grass=wet", "grass=dry"}
    wet = rows["grass=wet"]
    assert (wet.n_a, wet.n_b) == (3, 2)
    assert (wet.a, wet.b, wet.difference) == (2 / 3, 0.0, -2 / 3)
    assert (wet.low, wet.high, wet.p_holm, wet.cliffs_delta) == (None, None, None, None)


def test_words_that_one_run_alone_has_are_told() -> None:
    rows = [row for _, row in tables.difference_rows(compare(table(["", ""]), table(["wet", ""])))]
    (wet,) = (row for row in rows if row.quantity == "grass=wet")
    assert (wet.n_a, wet.n_b, wet.a, wet.b, wet.difference) == (None, 1, None, 1, None)

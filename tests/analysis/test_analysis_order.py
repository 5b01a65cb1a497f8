"""Tests of repeats that hang together: exact variances, a stated rate of false alarms, and what is found."""

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from fieldkit.analysis import order
from fieldkit.cli import main
from tests.helpers.tables import ROW, RepeatRow, replace, write

START_NS = 1_795_262_410_000_000_000


def autoregressive(random: np.random.Generator, cells: int, n: int, kept: float) -> order.Floats:
    values = np.zeros((cells, n + 50))
    for at in range(1, n + 50):
        values[:, at] = kept * values[:, at - 1] + random.normal(size=cells)
    return values[:, 50:]


@pytest.mark.parametrize("ranks", [[0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 2, 2], [0, 0, 5, 5, 5, 9]])
def test_the_variances_are_those_over_all_orders(ranks: list[int]) -> None:
    off = np.array(list(permutations(ranks)), dtype=np.float64)
    off -= off.mean(axis=1, keepdims=True)
    statistic, variance = order._alike(off)
    assert statistic.mean() == pytest.approx(0, abs=1e-12)
    assert variance == pytest.approx(statistic.var())
    correlation, variance = order._trend(off)
    assert variance == pytest.approx((correlation**2).mean())


def test_ranks_and_trend_are_scipys() -> None:
    values = np.random.default_rng(1).integers(0, 6, (9, 25)).astype(float)
    assert order._ranks(values) + 1 == pytest.approx(stats.rankdata(values, axis=1))
    off = order._ranks(values)
    off -= off.mean(axis=1, keepdims=True)
    theirs = [stats.spearmanr(row, np.arange(25)) for row in values]
    correlation, variance = order._trend(off)
    assert correlation == pytest.approx([abs(one.statistic) for one in theirs])
    assert 2 * order._tail(correlation, variance) == pytest.approx([one.pvalue for one in theirs], rel=0.02)


def test_the_correction_is_scipys() -> None:
    some = np.random.default_rng(2).random(40) ** 3
    assert order.corrected(some) == pytest.approx(stats.false_discovery_control(some))
    assert not len(order.corrected(np.empty(0)))


@pytest.mark.parametrize("n", [10, 20, 40])
@pytest.mark.parametrize("ties", [False, True])
def test_tables_of_independent_repeats_have_a_mark_in_about_one_of_twenty(n: int, ties: bool) -> None:
    random = np.random.default_rng(3)
    tables, cells = 1500, 30
    drawn = random.binomial(29, 0.3, (tables * cells, n)) if ties else random.normal(size=(tables * cells, n))
    values = np.asarray(drawn, dtype=np.float64)
    found = np.nan_to_num(order.p_values(values), nan=1.0).reshape(tables, cells)
    marked = np.mean([(order.corrected(one) < 0.05).any() for one in found])
    assert 0.03 < marked < 0.08


@pytest.mark.parametrize(("n", "kept", "found"), [(10, 0.8, 48), (20, 0.8, 86), (40, 0.8, 99), (20, 0.5, 51)])
def test_repeats_that_hang_together_are_found_as_often_as_the_docs_say(n: int, kept: float, found: float) -> None:
    values = autoregressive(np.random.default_rng(4), 4000, n, kept)
    assert 100 * (order.p_values(values) < 0.05).mean() == pytest.approx(found, abs=2.5)


def test_what_cannot_be_tested_is_not() -> None:
    assert np.isnan(order.p_values(np.arange(9.0)[None])).all()
    assert np.isnan(order.p_values(np.array([[1.0, 2.0] * 10]))).all()
    assert order.p_values(np.arange(10.0)[None]) < 1e-6


def rows(times_s: list[float]) -> list[RepeatRow]:
    """Repeats whose rows stand in another order than they were made in."""
    made = [
        replace(ROW, repeat=1 + n, started_utc_ns=START_NS + n * 10**10, transfer_s=time_s, rtt_median_s=None)
        for n, time_s in enumerate(times_s)
    ]
    return [made[at] for at in np.random.default_rng(5).permutation(len(made))]


def test_a_trend_is_told_beside_the_table_and_in_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(6).normal(0, 0.2, 20)
    path = write(tmp_path, rows([1 + 0.1 * n + noise[n] for n in range(20)]))
    words = ["aggregate", str(path), "--quantity", "transfer_s", "--format"]
    assert main([*words, "table"]) == 0
    said = capsys.readouterr().out
    assert "]!" in said
    assert "! repeats are not independent in time" in said
    assert "Randomize the order" in said
    assert main([*words, "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "transfer time" in found["cautions"][0]
    assert found["cells"][0]["estimates"]["transfer_s"]["p_order"] < 0.001


def test_repeats_of_unknown_moments_are_not_tested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = rows([1.0 + n for n in range(20)])
    path = write(tmp_path, [replace(made[0], started_utc_ns=None), *made[1:]])
    assert main(["aggregate", str(path), "--quantity", "transfer_s", "--format", "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cautions"] == []
    assert found["cells"][0]["estimates"]["transfer_s"]["p_order"] is None


def test_a_median_of_few_repeats_says_what_it_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, rows([1.0, 2.0, 4.0, 4.5]))
    assert main(["aggregate", str(path), "--quantity", "transfer_s"]) == 0
    said = capsys.readouterr().out
    assert "]*" in said
    assert (
        "* 95 % interval assuming a normal distribution; without that assumption 4 repeats give 88 %. "
        "Use 6 or more repeats"
    ) in said

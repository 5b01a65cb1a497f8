"""Statistical tests of independence in time: exact variances, false positive rate, and power."""

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import scipy

from fieldkit.analysis import independence
from fieldkit.cli import main
from tests.helpers.tables import ROW, RepeatRow, replace, write

START_NS = 1_795_262_410_000_000_000


def autoregressive(random: np.random.Generator, cells: int, n: int, coefficient: float) -> independence.Floats:
    values = np.zeros((cells, n + 50))
    for index in range(1, n + 50):
        values[:, index] = coefficient * values[:, index - 1] + random.normal(size=cells)
    return values[:, 50:]


@pytest.mark.parametrize("ranks", [[0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 2, 2], [0, 0, 5, 5, 5, 9]])
def test_the_variances_equal_those_over_all_permutations(ranks: list[int]) -> None:
    centred = np.array(list(permutations(ranks)), dtype=np.float64)
    centred -= centred.mean(axis=1, keepdims=True)
    statistic, variance = independence._von_neumann(centred)
    assert statistic.mean() == pytest.approx(0, abs=1e-12)
    assert variance == pytest.approx(statistic.var())
    correlation, variance = independence._spearman(centred)
    assert variance == pytest.approx((correlation**2).mean())


def test_ranks_and_trend_equal_scipy() -> None:
    values = np.random.default_rng(1).integers(0, 6, (9, 25)).astype(float)
    assert independence._ranks(values) + 1 == pytest.approx(scipy.stats.rankdata(values, axis=1))
    centred = independence._ranks(values)
    centred -= centred.mean(axis=1, keepdims=True)
    scipy_results = [scipy.stats.spearmanr(row, np.arange(25)) for row in values]
    correlation, variance = independence._spearman(centred)
    assert correlation == pytest.approx([abs(result.statistic) for result in scipy_results])
    assert 2 * independence._upper_tail(correlation, variance) == pytest.approx(
        [result.pvalue for result in scipy_results], rel=0.02
    )


def test_the_correction_equals_scipy() -> None:
    p_values = np.random.default_rng(2).random(40) ** 3
    assert independence.corrected(p_values) == pytest.approx(scipy.stats.false_discovery_control(p_values))
    assert not len(independence.corrected(np.empty(0)))


@pytest.mark.parametrize("n", [10, 20, 40])
@pytest.mark.parametrize("ties", [False, True])
def test_about_5_percent_of_the_tables_of_independent_repeats_have_a_mark(n: int, ties: bool) -> None:
    random = np.random.default_rng(3)
    tables, cells = 1500, 30
    samples = random.binomial(29, 0.3, (tables * cells, n)) if ties else random.normal(size=(tables * cells, n))
    values = np.asarray(samples, dtype=np.float64)
    result = np.nan_to_num(independence.p_values(values), nan=1.0).reshape(tables, cells)
    marked_share = np.mean([(independence.corrected(table_p_values) < 0.05).any() for table_p_values in result])
    assert 0.03 < marked_share < 0.08


@pytest.mark.parametrize(("n", "coefficient", "result"), [(10, 0.8, 48), (20, 0.8, 86), (40, 0.8, 99), (20, 0.5, 51)])
def test_the_power_for_dependent_repeats_equals_that_in_the_docs(n: int, coefficient: float, result: float) -> None:
    values = autoregressive(np.random.default_rng(4), 4000, n, coefficient)
    assert 100 * (independence.p_values(values) < 0.05).mean() == pytest.approx(result, abs=2.5)


def test_too_few_repeats_or_values_are_not_tested() -> None:
    assert np.isnan(independence.p_values(np.arange(9.0)[None])).all()
    assert np.isnan(independence.p_values(np.array([[1.0, 2.0] * 10]))).all()
    assert independence.p_values(np.arange(10.0)[None]) < 1e-6


def rows(times_s: list[float]) -> list[RepeatRow]:
    """Return repeats whose rows are not in chronological order."""
    table = [
        replace(ROW, repeat=1 + n, started_utc_ns=START_NS + n * 10**10, transfer_s=time_s, rtt_median_s=None)
        for n, time_s in enumerate(times_s)
    ]
    return [table[index] for index in np.random.default_rng(5).permutation(len(table))]


def test_a_trend_is_reported_in_tables_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(6).normal(0, 0.2, 20)
    path = write(tmp_path, rows([1 + 0.1 * n + noise[n] for n in range(20)]))
    argv = ["aggregate", str(path), "--quantity", "transfer_s", "--format"]
    assert main([*argv, "table"]) == 0
    output = capsys.readouterr().out
    assert "]!" in output
    assert "! repeats are not independent in time" in output
    assert "Randomize the order" in output
    assert main([*argv, "json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "transfer time" in result["cautions"][0]
    assert result["cells"][0]["estimates"]["transfer_s"]["p_order"] < 0.001


def test_repeats_without_start_times_are_not_tested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = rows([1.0 + n for n in range(20)])
    path = write(tmp_path, [replace(table[0], started_utc_ns=None), *table[1:]])
    assert main(["aggregate", str(path), "--quantity", "transfer_s", "--format", "json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["cautions"] == []
    assert result["cells"][0]["estimates"]["transfer_s"]["p_order"] is None


def test_a_median_of_few_repeats_states_its_coverage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, rows([1.0, 2.0, 4.0, 4.5]))
    assert main(["aggregate", str(path), "--quantity", "transfer_s"]) == 0
    output = capsys.readouterr().out
    assert "]*" in output
    assert (
        "* 95 % interval assuming a normal distribution; without that assumption 4 repeats give 88 %. "
        "Use 6 or more repeats"
    ) in output

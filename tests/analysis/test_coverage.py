"""Coverage of the 95 % intervals by simulation, compared with the tables of coverage.md."""

import re
from collections.abc import Callable
from pathlib import Path
from statistics import NormalDist
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from fieldkit.analysis.statistics import (
    Intervals,
    guaranteed_coverage,
    mean_shares,
    means,
    medians,
    shares,
    wilson_intervals,
)
from tests.helpers.nightly import mark_nightly

CELLS: Final = 4000  # leaves a standard error of 0.35 % at a coverage of 95 %
REPEATS: Final = 20
MAX_MEDIAN_COVERAGE: Final = 98.6
"""Order statistics are discrete, so the coverage of their intervals may be above 95 %."""
BAND: Final = (93.0, 97.0)
BURSTS: Final = (0, 1, 5, 20)  # mean length of a burst; 0: independent losses; 1: never two consecutive losses
RATES: Final = (0.01, 0.05, 0.35)
# At most seven losses or two bursts are expected in a cell, so a cell without losses is likely, and an interval can
# miss the true value only on one side.
RARE: Final = {(36, 0.01)}
TABLES: Final = Path(__file__).with_name("coverage.md")

Floats = NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, int]], Floats]


def burst_losses(
    random: np.random.Generator, rate: float, burst: int, shape: tuple[int, int], packets: int
) -> NDArray[np.int64]:
    """Return the number of lost packets per repeat on a Gilbert-Elliott link, whose bad state loses all packets."""
    if burst == 0:
        return random.binomial(packets, rate, shape)
    recovery_probability = 1 / burst
    failure_probability = recovery_probability * rate / (1 - rate)
    bad = random.random(shape) < rate
    n_lost = bad.astype(np.int64)
    for _ in range(packets - 1):
        uniform = random.random(shape, dtype=np.float32)
        bad = np.where(bad, uniform >= recovery_probability, uniform < failure_probability)
        n_lost += bad
    return n_lost


def coverage_percent(intervals: Intervals, truth: float) -> float:
    """Return the percentage of cells whose interval contains the true value, with a tolerance for rounding."""
    slack = 1e-9
    return 100 * float(np.mean((intervals.low <= truth + slack) & (truth - slack <= intervals.high)))


def table_row(*key: str) -> list[float]:
    """Return the numbers of the row of coverage.md that starts with these cells."""
    row_start = re.escape("| " + " | ".join(key) + " |")
    (row,) = re.findall(rf"^{row_start}(.*)\|$", TABLES.read_text(encoding="utf-8"), re.MULTILINE)
    return [float(number) for number in row.split("|")]


@pytest.mark.parametrize("rate", mark_nightly(RATES))
@pytest.mark.parametrize("packets", mark_nightly([36, 215]))
def test_intervals_of_shares_cover_for_any_burst_length(
    packets: int, rate: float, record_property: Callable[[str, object], None]
) -> None:
    random = np.random.default_rng(11)
    coverages, wilson_coverages = [], []
    for burst in BURSTS:
        n_lost = burst_losses(random, rate, burst, (CELLS, REPEATS), packets)
        n_sent = np.full(n_lost.shape, packets)
        coverages.append(coverage_percent(shares(n_lost, n_sent), rate))
        wilson_coverages.append(coverage_percent(wilson_intervals(n_lost.sum(axis=1), n_sent.sum(axis=1)), rate))
    record_property(
        "result", f"share, 20 repeats of {packets}, {rate:.0%} lost, bursts {BURSTS}: {as_text(coverages)}"
    )
    record_property("result", f"the same by Wilson: {as_text(wilson_coverages)}")
    low, high = (96.0, 99.5) if (packets, rate) in RARE else BAND
    assert all(low <= percentage <= high for percentage in coverages)
    assert BAND[0] <= wilson_coverages[0] <= BAND[1], "Wilson interval, independent losses"
    assert wilson_coverages[-1] < 75, "Wilson interval, long bursts"
    assert table_row(f"{packets}", f"{rate:.0%}".replace("%", " %")) == pytest.approx(
        [*coverages, wilson_coverages[0], wilson_coverages[-1]], abs=0.8
    )


@pytest.mark.parametrize("n", mark_nightly([2, 3, 5, 10]))
def test_intervals_of_shares_of_few_repeats_have_nearly_the_same_coverage(
    n: int, record_property: Callable[[str, object], None]
) -> None:
    random = np.random.default_rng(12)
    coverages = [
        coverage_percent(
            shares(burst_losses(random, rate, burst, (CELLS, n), 36), np.full((CELLS, n), 36)),
            rate,
        )
        for rate in RATES
        for burst in BURSTS
    ]
    record_property("result", f"share, {n} repeats of 36: {min(coverages):.1f} to {max(coverages):.1f} %")
    assert min(coverages) > 92


@pytest.mark.parametrize("burst", mark_nightly(BURSTS, in_ci=[5]))
def test_intervals_of_shares_cover_if_repeats_send_different_numbers(
    burst: int, record_property: Callable[[str, object], None]
) -> None:
    random = np.random.default_rng(13)
    n_sent = np.concatenate([np.full((CELLS, 10), size) for size in (36, 215)], axis=1)
    n_lost = np.concatenate([burst_losses(random, 0.05, burst, (CELLS, 10), size) for size in (36, 215)], axis=1)
    coverages = coverage_percent(shares(n_lost, n_sent), 0.05)
    record_property(
        "result", f"share, 10 repeats of 36 and 10 of 215, 5 % lost, bursts of {burst}: {coverages:.1f} %"
    )
    assert BAND[0] <= coverages <= BAND[1]


@pytest.mark.parametrize("rate", mark_nightly([0.05, 0.35]))
@pytest.mark.parametrize("largest", mark_nightly([36, 540]))
def test_shares_cover_less_if_repeats_differ_strongly(
    rate: float, largest: int, record_property: Callable[[str, object], None]
) -> None:
    """Each repeat has another share, from a beta distribution with an intraclass correlation of 0.3."""
    random, prior = np.random.default_rng(17), 1 / 0.3 - 1
    coverages = []
    for n in (5, 10, 20, 40):
        n_sent = np.broadcast_to(np.where(np.arange(n) % 2, largest, 36), (CELLS, n))
        n_lost = random.binomial(n_sent, random.beta(prior * rate, prior * (1 - rate), n_sent.shape))
        coverages.append(coverage_percent(shares(n_lost, n_sent), rate))
    label = f"{rate:.0%} lost, ".replace("%", " %") + (
        "all of 36" if largest == 36 else f"half of 36, half of {largest}"
    )
    record_property("result", f"share, repeats that differ by far, {label}: {as_text(coverages)}")
    assert table_row(label) == pytest.approx(coverages, abs=0.8)


def lognormal(sigma: float) -> Draw:
    return lambda random, shape: random.lognormal(0, sigma, shape)


TIMES: Final[dict[str, tuple[Draw, float, float]]] = {
    "normal": (lambda random, shape: random.normal(0, 1, shape), 0.0, 0.0),
    "lognormal, sigma 0.5": (lognormal(0.5), float(np.exp(0.125)), 1.0),
    "lognormal, sigma 1": (lognormal(1.0), float(np.exp(0.5)), 1.0),
}


def percentile_bootstrap(random: np.random.Generator, values: Floats) -> Intervals:
    """Return percentile bootstrap intervals of means; all cells share their 1,000 draws."""
    n = values.shape[1]
    means = values @ random.multinomial(n, np.full(n, 1 / n), 1000).T / n
    low, high = np.quantile(means, (0.025, 0.975), axis=1)
    return Intervals(values.mean(axis=1), low, high)


@pytest.mark.parametrize("name", mark_nightly(TIMES, in_ci=["lognormal, sigma 1"]))
def test_means_and_medians_cover_skewed_repeats(name: str, record_property: Callable[[str, object], None]) -> None:
    random = np.random.default_rng(14)
    draw, mean, true_median = TIMES[name]
    samples = [draw(random, (CELLS, n)) for n in (5, 10, REPEATS)]
    mean_coverages = [coverage_percent(means(values), mean) for values in samples]
    median_coverages = [coverage_percent(medians(values), true_median) for values in samples]
    bootstrap_coverage = coverage_percent(percentile_bootstrap(random, samples[-1]), mean)
    record_property(
        "result",
        f"mean, {name}, 5, 10, 20 repeats: {as_text(mean_coverages)}, percentile bootstrap {bootstrap_coverage:.1f}",
    )
    record_property("result", f"median, {name}, 5, 10, 20 repeats: {as_text(median_coverages)}")
    assert BAND[0] <= mean_coverages[-1] <= BAND[1]
    assert all(BAND[0] <= percentage <= MAX_MEDIAN_COVERAGE for percentage in median_coverages)
    assert abs(mean_coverages[-1] - 95) < abs(bootstrap_coverage - 95)
    assert table_row(name) == pytest.approx([*mean_coverages, bootstrap_coverage, *median_coverages], abs=0.8)


@pytest.mark.parametrize("burst", mark_nightly([5, 20]))
def test_means_and_medians_cover_bursty_shares(burst: int, record_property: Callable[[str, object], None]) -> None:
    random = np.random.default_rng(15)
    packets, rate = 215, 0.35
    true_median = float(np.median(burst_losses(random, rate, burst, (1, 100_000), packets))) / packets
    shares = [burst_losses(random, rate, burst, (CELLS, n), packets) / packets for n in (5, 10, REPEATS)]
    mean_coverages = [coverage_percent(mean_shares(values), rate) for values in shares]
    median_coverages = [coverage_percent(medians(values), true_median) for values in shares]
    bootstrap_coverage = coverage_percent(percentile_bootstrap(random, shares[-1]), rate)
    record_property(
        "result",
        f"shares lost, bursts of {burst}: mean {as_text(mean_coverages)}, median {as_text(median_coverages)}",
    )
    assert all(BAND[0] <= percentage <= BAND[1] for percentage in mean_coverages)
    assert all(BAND[0] <= percentage <= MAX_MEDIAN_COVERAGE for percentage in median_coverages)
    assert table_row(f"share lost, bursts of {burst}") == pytest.approx(
        [*mean_coverages, bootstrap_coverage, *median_coverages], abs=0.8
    )


def two_modes(share: float, apart: float) -> tuple[Draw, float]:
    """Return a mixture of two normal distributions, with `share` in the lower one, and its median."""

    def draw(random: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        return np.where(random.random(shape) < share, random.normal(0, 1, shape), random.normal(apart, 1, shape))

    return draw, apart / 2 if share == 0.5 else NormalDist().inv_cdf(0.5 / share)


SHAPES: Final[dict[str, tuple[Draw, float]]] = {
    "normal": (lambda random, shape: random.normal(0, 1, shape), 0.0),
    "lognormal, sigma 1": (lognormal(1.0), 1.0),
    "two modes, 50:50": two_modes(0.5, 10),
    "two modes, 60:40": two_modes(0.6, 10),
    "two modes, 80:20": two_modes(0.8, 10),
    "one of three values": (lambda random, shape: random.integers(0, 3, shape).astype(float), 1.0),
    "one of two values, 55:45": (lambda random, shape: (random.random(shape) < 0.45).astype(float), 0.0),
}
REPEAT_NUMBERS: Final = (2, 3, 4, 5, 6, 7, 10, 20, 30)


@pytest.mark.parametrize("name", mark_nightly(SHAPES, in_ci=["two modes, 60:40"]))
def test_medians_have_the_guaranteed_coverage_for_any_distribution(
    name: str, record_property: Callable[[str, object], None]
) -> None:
    random = np.random.default_rng(16)
    draw, true_median = SHAPES[name]
    coverages = {n: coverage_percent(medians(draw(random, (CELLS, n))), true_median) for n in REPEAT_NUMBERS}
    record_property("result", f"median, {name}, of {REPEAT_NUMBERS}: {as_text(list(coverages.values()))}")
    assert all(percentage >= 100 * guaranteed_coverage(n) - 1 for n, percentage in coverages.items())
    assert table_row(f"median, {name}") == pytest.approx(list(coverages.values()), abs=0.8)


def as_text(coverages: list[float]) -> str:
    return ", ".join(f"{percentage:.1f}" for percentage in coverages)

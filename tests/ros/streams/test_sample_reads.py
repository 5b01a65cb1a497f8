"""Age of the newest sample at reads: closed forms, a simulation read by read, and contradictions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import Measured
from fieldkit.measure.transfers.clock_offset import Clocks
from fieldkit.ros.streams import read_checks, sample_reads
from fieldkit.ros.streams.sample_reads import ReadPlan
from fieldkit.ros.streams.topic_samples import SampleReads, TopicLog, TopicSamples

START = 1_795_000_000_000_000_000
AHEAD_S = 3.0
"""The offset of the subscriber's clock."""
ERROR_S = 1e-5
RATE_HZ, READS_HZ, SAMPLES = 20.0, 61.803, 400
NAMES = [column.name for column in sample_reads.declare_columns("used", "topic_sent")]
CLOCKS = Clocks(START, round(1e9 * AHEAD_S), 0.0, 0.0, np.zeros(1), np.full(1, -ERROR_S), np.full(1, ERROR_S))


def ns(at_s: "np.typing.ArrayLike", ahead_s: float = 0.0) -> "np.typing.NDArray[np.int64]":
    return START + np.round(1e9 * (np.asarray(at_s, dtype=np.float64) + ahead_s)).astype(np.int64)


def log(sequence: "np.typing.ArrayLike", sent_s: "np.typing.ArrayLike", at_ns: "np.typing.ArrayLike") -> TopicLog:
    numbers = np.asarray(sequence, dtype=np.int64)
    samples = TopicSamples(numbers, np.full(len(numbers), 64), ns(sent_s), np.asarray(at_ns, dtype=np.int64))
    return TopicLog(samples, START, START, 0, 0, 0, is_complete=True)


class Run:
    """A stream whose samples arrive after given delays (nan: lost), read at times of the subscriber's clock."""

    def __init__(self, delays_s: "np.typing.ArrayLike", reads_hz: float = READS_HZ, phase_s: float = 0.003) -> None:
        delays = np.asarray(delays_s, dtype=np.float64)
        self.sent_s = np.arange(len(delays)) / RATE_HZ
        self.read_s = np.arange(-0.5, len(delays) / RATE_HZ + 1, 1 / reads_hz) + phase_s
        self.arrival_s = self.sent_s + delays
        # Read by read, independent of the code under test.
        newest = [
            max((n for n, at_s in enumerate(self.arrival_s) if at_s <= read_s), default=-1) for read_s in self.read_s
        ]
        self.newest = np.array(newest, dtype=np.int64)
        self.sent = log(np.arange(len(delays)), self.sent_s, ns(self.sent_s))
        arrived = np.flatnonzero(np.isfinite(delays))
        arrived = arrived[np.argsort(self.arrival_s[arrived], kind="stable")]
        stamps = np.where(self.newest >= 0, ns(self.sent_s[self.newest]), 0)
        self.received = replace(
            log(arrived, self.sent_s[arrived], ns(self.arrival_s[arrived], AHEAD_S)),
            reads=SampleReads(self.newest, stamps, ns(self.read_s, AHEAD_S)),
        )

    def measured(self, clocks: Clocks | None = CLOCKS, limit_s: float = 0.5, reads_hz: float = READS_HZ) -> Measured:
        plan = ReadPlan("used", reads_hz, limit_s, 1 / RATE_HZ)
        result = sample_reads.measure(plan, self.sent, self.received, clocks, "there are no captures")
        assert sorted({**result.values, **result.missing}) == sorted(NAMES)
        return result

    def values(self, **options: float) -> dict[str, float]:
        return {
            name.removeprefix("used_"): value
            for name, value in self.measured(**options).values.items()  # type: ignore[arg-type]
            if not isinstance(value, str)
        }


@pytest.mark.parametrize("delay_s", [0.002, 0.03, 0.4])
def test_closed_form_of_a_constant_delay(delay_s: float) -> None:
    """Age of information with constant delay D and interval T: mean D + T/2, 95th percentile D + 0.95 T."""
    interval_s = 1 / RATE_HZ
    values = Run(np.full(SAMPLES, delay_s)).values()
    assert values["age_mean_s"] == pytest.approx(delay_s + interval_s / 2, abs=2e-4)
    assert values["age_p95_s"] == pytest.approx(delay_s + 0.95 * interval_s, abs=1e-3)
    assert values["age_max_s"] == pytest.approx(delay_s + interval_s, abs=1e-3)
    assert values["age_error_s"] == pytest.approx(ERROR_S)
    assert (values["blank"], values["never"], values["late"], values["gaps"]) == (0, 0, 0, 0)
    assert values["distinct"] == SAMPLES
    # A read interval d repeats a sample in 1 - d/T of the reads if d < T.
    assert values["repeated"] == pytest.approx(1 - RATE_HZ / READS_HZ, abs=2e-3)
    assert interval_s <= values["gap_s"] < interval_s + 1 / READS_HZ


def test_slow_reads_leave_samples_out() -> None:
    values = Run(np.full(SAMPLES, 0.01), reads_hz=7.13).values(reads_hz=7.13)
    assert values["never"] == pytest.approx(1 - 7.13 / RATE_HZ, abs=0.02)
    assert values["repeated"] == 0
    assert values["age_mean_s"] == pytest.approx(0.01 + 0.5 / RATE_HZ, abs=2e-3)


DELAYS = st.lists(st.one_of(st.floats(0.001, 0.6), st.just(float("nan"))), min_size=5, max_size=40)


@given(DELAYS, st.floats(0, 0.016))
def test_equals_a_simulation_read_by_read(delays_s: list[float], phase_s: float) -> None:
    run = Run(delays_s, phase_s=phase_s)
    assert list(read_checks.check_reads(run.received)) == []
    if not np.isfinite(delays_s).any():
        assert run.measured().values == {"used_distinct": 0, "used_never": 1.0, "used_withheld": "no sample arrived"}
        return
    fastest_s = float(np.nanmin(delays_s))
    begin_s, end_s = fastest_s, fastest_s + len(delays_s) / RATE_HZ
    ages, blank, repeated, gaps, changed_s, seen = list[float](), 0, 0, list[float](), begin_s, -1
    for index, (read_s, newest) in enumerate(zip(run.read_s, run.newest, strict=True)):
        if not begin_s <= read_s < end_s:
            continue
        blank += newest < 0
        repeated += newest >= 0 and newest == run.newest[index - 1]
        if newest >= 0:
            ages.append(read_s - run.sent_s[newest])
        if newest > seen:
            gaps.append(read_s - changed_s)
            changed_s, seen = read_s, newest
    gaps.append(end_s - changed_s)
    result, reads = run.measured(limit_s=0.2), len(ages) + blank
    assert result.values["used_reads"] == reads
    assert result.values["used_blank"] == pytest.approx(blank / reads)
    assert result.values["used_repeated"] == pytest.approx(repeated / reads)
    assert result.values["used_gap_s"] == pytest.approx(max(gaps), abs=1e-6)
    if all(abs(gap_s - 0.2) > 1e-6 for gap_s in gaps):
        assert result.values["used_gaps"] == sum(gap_s > 0.2 for gap_s in gaps)
    if ages and min(np.mean(ages), np.max(ages)) > 10.1 * ERROR_S:
        assert result.values["used_age_mean_s"] == pytest.approx(np.mean(ages), abs=1e-6)
        assert result.values["used_age_max_s"] == pytest.approx(np.max(ages), abs=1e-6)
        with_blanks = np.sort(np.concatenate((ages, np.full(blank, 1e6))))
        p95 = float(np.quantile(with_blanks, 0.95))
        if "used_age_p95_s" in result.values:
            assert result.values["used_age_p95_s"] == pytest.approx(p95, abs=1e-6)
        else:
            assert p95 > 1e3, "a blank read is older than all others"


def test_age_grows_by_the_length_of_a_cut() -> None:
    delays = np.full(SAMPLES, 0.01)
    delays[100:140] = np.nan  # 2 s
    values = Run(delays).values()
    assert values["age_max_s"] == pytest.approx(0.01 + 41 / RATE_HZ, abs=1 / READS_HZ)
    assert values["gap_s"] == pytest.approx(41 / RATE_HZ, abs=2 / READS_HZ)
    assert values["gaps"] == 1
    assert values["never"] == pytest.approx(40 / SAMPLES)


def test_a_stream_cut_off_at_its_end_becomes_old() -> None:
    delays = np.full(SAMPLES, 0.01)
    delays[200:] = np.nan
    assert Run(delays).values()["age_max_s"] == pytest.approx(0.01 + 201 / RATE_HZ, abs=2 / READS_HZ)


def test_samples_after_a_newer_one_or_above_the_limit_are_late() -> None:
    delays = np.full(100, 0.01)
    delays[10] = 0.12  # after two newer ones
    delays[99] = 0.6
    assert Run(delays).values()["late"] == pytest.approx(2 / 100)


def test_a_blank_start_counts_as_older_than_all_frames() -> None:
    delays = np.full(100, 0.01)
    delays[:10] = np.nan
    result = Run(delays).measured()
    assert result.values["used_blank"] == pytest.approx(0.1, abs=0.02)
    assert "used_age_p95_s" in result.missing
    assert result.values["used_withheld"] == "5 % or more of the reads were before the first sample"


def test_bad_clocks_withhold_ages_but_not_counts() -> None:
    run = Run(np.full(100, 0.01))
    without = run.measured(clocks=None)
    assert without.values["used_withheld"] == "there are no captures"
    assert {"used_age_p95_s", "used_age_mean_s", "used_age_max_s", "used_late"} <= without.missing.keys()
    assert without.values["used_repeated"] == run.measured().values["used_repeated"]
    wide = replace(CLOCKS, lowest_s=np.full(1, -0.0045), highest_s=np.full(1, 0.0045))
    partly = run.measured(clocks=wide)
    assert partly.values["used_withheld"] == "the clock error is above a tenth of an age"
    assert "used_age_mean_s" in partly.missing
    assert partly.values["used_age_p95_s"] == pytest.approx(0.01 + 0.95 / RATE_HZ, abs=2e-3)


def test_a_program_that_missed_reads_has_no_ages() -> None:
    run = Run(np.full(100, 0.01))
    reads = run.received.reads
    run.received = replace(run.received, reads=reads.where(np.arange(len(reads)) % 5 > 0))
    withheld = run.measured().values["used_withheld"]
    assert isinstance(withheld, str)
    assert withheld.startswith("the program read ")


def test_incomplete_log_has_no_values() -> None:
    plan = ReadPlan("used", READS_HZ, 0.5, 0.05)
    result = sample_reads.measure(plan, None, Run(np.full(5, 0.01)).received, CLOCKS, "")
    assert result.values == {"used_withheld": "there are no complete logs of both ends"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sequence": 1}, "returned a sample before it arrived"),
        ({"sequence": -12}, "did not return the newest sample"),
        ({"sent_ns": 1_000}, "another time of sending"),
        ({"at_ns": -60_000_000}, "returned a sample before it arrived"),
    ],
)
def test_contradictions_between_reads_and_arrivals(change: dict[str, int], message: str) -> None:
    run = Run(np.full(100, 0.01))
    reads = run.received.reads
    changed = (np.arange(len(reads)) >= 100) & (np.arange(len(reads)) < 161)
    columns = {name: column + change.get(name, 0) * changed for name, column in vars(reads).items()}
    received = replace(run.received, reads=SampleReads(**columns))
    assert any(message in reason for reason in read_checks.check_reads(received))

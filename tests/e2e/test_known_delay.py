"""Complete trials over a radio with a known delay.

The delay of the machine is measured with a radio without delay in the same run.
"""

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.helpers.known_radio import make_lab, run_all
from tests.helpers.nightly import mark_nightly

pytestmark = [pytest.mark.emulated, pytest.mark.quiet]


@dataclass(frozen=True)
class DelayTrial:
    """The rows of a trial over a radio with a delay.

    Attributes:
        delay_ms: Delay of the radio.
        table: Its rows.
    """

    delay_ms: int
    table: list[dict[str, str]]


def run_trial(folder: Path, delay_ms: int) -> DelayTrial:
    lab = make_lab(folder / str(delay_ms), f"{{loss: 0%, delay: {delay_ms}ms, rate: unlimited}}", pings=50)
    return DelayTrial(delay_ms, run_all([lab], "--repeats", "1")[str(delay_ms)])


@pytest.fixture(scope="module")
def table_without_delay(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    return run_trial(tmp_path_factory.mktemp("delay"), 0).table


@pytest.fixture(scope="module", params=mark_nightly([20, 5]))
def trial(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> DelayTrial:
    return run_trial(tmp_path_factory.mktemp("delay"), request.param)


def test_rtt_is_twice_the_delay_of_the_link(trial: DelayTrial, table_without_delay: list[dict[str, str]]) -> None:
    """A busy machine increases the median, but it hardly increases the minimum of 50 pings."""
    delay_ms = trial.delay_ms
    assert [row["rtt_payload_bytes"] for row in trial.table] == ["502", "8192"]
    for row, expected in zip(trial.table, table_without_delay, strict=True):
        min_ms, baseline_ms = (1e3 * float(pings["rtt_min_s"]) for pings in (row, expected))
        assert min_ms - baseline_ms == pytest.approx(2 * delay_ms, abs=0.5)
        assert 2 * delay_ms <= min_ms <= 1e3 * float(row["rtt_median_s"]) <= 2 * delay_ms + 5


def test_the_offset_of_a_clock_to_itself_is_zero(
    trial: DelayTrial, table_without_delay: list[dict[str, str]]
) -> None:
    """Both robots use this machine's clock, so the true offset is 0; half a round trip is the delay of the link."""
    delay_s = 1e-3 * trial.delay_ms
    machine_s = largest(table_without_delay, "rtt_median_s")
    for row in trial.table:
        offset_s, error_s = float(row["clock_offset_s"]), float(row["clock_offset_error_s"])
        assert abs(offset_s) <= min(error_s, 0.5e-3 + machine_s)
        assert delay_s <= error_s <= delay_s + 1e-3 + machine_s
        # Without a queue, the delay of the packets is not larger than the error.
        assert row["one_way_withheld"] == "the error is above a tenth of: min, median, mean, p95"
        assert row["one_way_median_s"] == "", "a missing value is empty"
        for name in ("delay_variation_p95_s", "jitter_s"):
            assert float(row[name]) < 1e-3 + largest(table_without_delay, name)


def test_the_delay_on_the_air_is_that_of_the_link(trial: DelayTrial) -> None:
    for row in trial.table:
        total_s, processing_s, propagation_s = (
            float(row[f"delay_{name}s"]) for name in ("", "processing_", "propagation_")
        )
        assert propagation_s == trial.delay_ms / 1e3
        assert (row["delay_transmission_s"], row["delay_queuing_s"]) == ("0", "0"), "the rate has no limit"
        assert 0 < processing_s < 5e-3, "each medium takes some time"
        assert total_s == pytest.approx(propagation_s + processing_s, rel=1e-8)
        # TCP's last acknowledgment may be in flight when both programs have exited, and ROS may send a packet.
        assert int(row["delay_packets"]) == pytest.approx(int(row["ip_packets_received"]), abs=2)


def largest(table: list[dict[str, str]], column: str) -> float:
    return max(float(row[column]) for row in table)

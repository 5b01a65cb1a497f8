"""A radio with known delay, measured by complete trials.

The delay of this machine itself is known from a radio without delay in the same run.
"""

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.helpers.known_radio import make_lab, run_all
from tests.helpers.nightly import mark_nightly

pytestmark = [pytest.mark.emulated, pytest.mark.quiet]


@dataclass(frozen=True)
class Delayed:
    """The rows of a trial.

    Attributes:
        delay_ms: Delay of the radio.
        table: Its rows.
    """

    delay_ms: int
    table: list[dict[str, str]]


def measured(folder: Path, delay_ms: int) -> Delayed:
    lab = make_lab(folder / str(delay_ms), f"{{loss: 0%, delay: {delay_ms}ms, rate: unlimited}}", pings=50)
    return Delayed(delay_ms, run_all([lab], "--repeats", "1")[str(delay_ms)])


@pytest.fixture(scope="module")
def undelayed(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    return measured(tmp_path_factory.mktemp("delay"), 0).table


@pytest.fixture(scope="module", params=mark_nightly([20, 5]))
def delayed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Delayed:
    return measured(tmp_path_factory.mktemp("delay"), request.param)


def test_rtt_is_twice_the_delay_of_the_link(delayed: Delayed, undelayed: list[dict[str, str]]) -> None:
    """A busy machine increases the median but, with 50 pings, hardly the minimum."""
    delay_ms = delayed.delay_ms
    assert [row["rtt_payload_bytes"] for row in delayed.table] == ["502", "8192"]
    for row, expected in zip(delayed.table, undelayed, strict=True):
        least_ms, baseline_ms = (1e3 * float(pings["rtt_min_s"]) for pings in (row, expected))
        assert least_ms - baseline_ms == pytest.approx(2 * delay_ms, abs=0.5)
        assert 2 * delay_ms <= least_ms <= 1e3 * float(row["rtt_median_s"]) <= 2 * delay_ms + 5


def test_the_offset_of_a_clock_to_itself_is_zero(delayed: Delayed, undelayed: list[dict[str, str]]) -> None:
    """Both robots use this machine's clock, so the true offset is 0; half a round trip is the delay of the link."""
    delay_s = 1e-3 * delayed.delay_ms
    own_s = largest(undelayed, "rtt_median_s")
    for row in delayed.table:
        offset_s, error_s = float(row["clock_offset_s"]), float(row["clock_offset_error_s"])
        assert abs(offset_s) <= min(error_s, 0.5e-3 + own_s)
        assert delay_s <= error_s <= delay_s + 1e-3 + own_s
        # Without a queue the packets take no longer than the error.
        assert row["one_way_withheld"] == "the error is above a tenth of: min, median, mean, p95"
        assert row["one_way_median_s"] == "", "missing is empty"
        for name in ("delay_variation_p95_s", "jitter_s"):
            assert float(row[name]) < 1e-3 + largest(undelayed, name)


def test_the_delay_on_the_air_is_that_of_the_link(delayed: Delayed) -> None:
    for row in delayed.table:
        whole_s, processing_s, propagation_s = (
            float(row[f"delay_{name}s"]) for name in ("", "processing_", "propagation_")
        )
        assert propagation_s == delayed.delay_ms / 1e3
        assert (row["delay_transmission_s"], row["delay_queuing_s"]) == ("0", "0"), "the rate has no limit"
        assert 0 < processing_s < 5e-3, "no medium is never late"
        assert whole_s == pytest.approx(propagation_s + processing_s, rel=1e-8)
        # TCP's last acknowledgment may still be in flight when both programs have ended, and ROS may send a packet.
        assert int(row["delay_packets"]) == pytest.approx(int(row["ip_packets_received"]), abs=2)


def largest(table: list[dict[str, str]], column: str) -> float:
    return max(float(row[column]) for row in table)

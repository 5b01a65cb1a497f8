"""A radio with known delay, measured by complete trials.

The delay of this machine itself is known from a radio without delay in the same run.
"""

import pytest

from tests.helpers.known_radio import make_lab, run_all

pytestmark = [pytest.mark.emulated, pytest.mark.quiet]


@pytest.fixture(scope="module")
def delayed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("delay")
    measured_one_by_one: dict[str, list[dict[str, str]]] = {}
    for delay_ms in (0, 5, 20):
        lab = make_lab(base / str(delay_ms), f"{{loss: 0%, delay: {delay_ms}ms, rate: unlimited}}", pings=50)
        measured_one_by_one |= run_all([lab], "--repeats", "1")
    return measured_one_by_one


@pytest.mark.parametrize("delay_ms", [5, 20])
def test_rtt_is_twice_the_delay_of_the_link(delayed: dict[str, list[dict[str, str]]], delay_ms: int) -> None:
    """A busy machine increases the median but, with 50 pings, hardly the minimum."""
    table = delayed[str(delay_ms)]
    assert [row["rtt_payload_bytes"] for row in table] == ["502", "8192"]
    for row, expected in zip(table, delayed["0"], strict=True):
        least_ms, baseline_ms = (1e3 * float(pings["rtt_min_s"]) for pings in (row, expected))
        assert least_ms - baseline_ms == pytest.approx(2 * delay_ms, abs=0.5)
        assert 2 * delay_ms <= least_ms <= 1e3 * float(row["rtt_median_s"]) <= 2 * delay_ms + 5


@pytest.mark.parametrize("delay_ms", [5, 20])
def test_the_offset_of_a_clock_to_itself_is_zero(delayed: dict[str, list[dict[str, str]]], delay_ms: int) -> None:
    """Both robots use this machine's clock, so the true offset is 0; half a round trip is the delay of the link."""
    own_s = largest(delayed["0"], "rtt_median_s")
    for row in delayed[str(delay_ms)]:
        offset_s, error_s = float(row["clock_offset_s"]), float(row["clock_offset_error_s"])
        assert abs(offset_s) <= min(error_s, 0.5e-3 + own_s)
        assert 1e-3 * delay_ms <= error_s <= 1e-3 * delay_ms + 1e-3 + own_s
        # Without a queue the packets take no longer than the error.
        assert row["one_way_withheld"] == "the error is above a tenth of: min, median, mean, p95"
        assert row["one_way_median_s"] == "", "missing is empty"
        for name in ("delay_variation_p95_s", "jitter_s"):
            assert float(row[name]) < 1e-3 + largest(delayed["0"], name)


@pytest.mark.parametrize("delay_ms", [5, 20])
def test_the_delay_on_the_air_is_that_of_the_link(delayed: dict[str, list[dict[str, str]]], delay_ms: int) -> None:
    table = delayed[str(delay_ms)]
    for row in table:
        whole_s, processing_s, propagation_s = (
            float(row[f"delay_{name}s"]) for name in ("", "processing_", "propagation_")
        )
        assert propagation_s == delay_ms / 1e3
        assert (row["delay_transmission_s"], row["delay_queuing_s"]) == ("0", "0"), "the rate has no limit"
        assert 0 < processing_s < 5e-3, "no medium is never late"
        assert whole_s == pytest.approx(propagation_s + processing_s, rel=1e-8)
        # TCP's last acknowledgment may still be in flight when both programs have ended, and ROS may send a packet.
        assert int(row["delay_packets"]) == pytest.approx(int(row["ip_packets_received"]), abs=2)


def largest(table: list[dict[str, str]], column: str) -> float:
    return max(float(row[column]) for row in table)

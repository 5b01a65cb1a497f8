"""Parsing of real outputs of four iperf3 versions on emulated robots (5 % loss, 2 ms, 20 Mbit/s)."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.evidence import iperf3
from tests.helpers.paths import DATA

VERSIONS = ("3.1.3", "3.7", "3.12", "3.17.1")
PAYLOAD_BYTES = 1400


def output(version: str, test: str, end: str) -> str:
    return (DATA / "iperf3" / version / f"{test}-{end}.json").read_text(encoding="utf-8")


def measure_values(version: str, test: str) -> dict[str, Any]:
    sends, receives = ("server", "client") if test.endswith("reverse") else ("client", "server")
    sender, receiver = (iperf3.parse(output(version, test, end)) for end in (sends, receives))
    result = iperf3.measure(Protocol(test[:3]), sender, receiver)
    assert result.values.keys() | result.missing.keys() == {column.name for column in iperf3.COLUMNS}
    return dict(result.values)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("test", ["udp", "udp-reverse"])
def test_the_counts_of_a_udp_test_agree_in_all_versions(version: str, test: str) -> None:
    values = measure_values(version, test)
    assert values["iperf3_received_bytes"] == PAYLOAD_BYTES * values["iperf3_datagrams_received"]
    assert values["iperf3_datagrams_sent"] == pytest.approx(values["iperf3_sent_bytes"] / PAYLOAD_BYTES, rel=0.02)
    assert 0.01 < values["iperf3_loss"] < 0.1, "the radio loses 5 %"
    assert values["iperf3_loss"] == 1 - values["iperf3_datagrams_received"] / values["iperf3_datagrams_sent"]
    assert values["iperf3_throughput_bit_s"] == pytest.approx(2e6 * (1 - values["iperf3_loss"]), rel=0.06)
    assert values["iperf3_interval_min_bit_s"] <= values["iperf3_interval_median_bit_s"]
    assert 0 < values["iperf3_jitter_s"] < 0.1
    assert "iperf3_retransmits" not in values


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("test", ["udp", "udp-reverse"])
def test_figures_equal_the_totals_of_the_receiver(version: str, test: str) -> None:
    """The totals are in the output of the client, where all versions report the receiver correctly."""
    end = json.loads(output(version, test, "client"))["end"]
    values = measure_values(version, test)
    n_lost = values["iperf3_datagrams_sent"] - values["iperf3_datagrams_received"]
    assert n_lost == end["sum"]["lost_packets"]
    if "sum_received" in end:
        assert values["iperf3_received_bytes"] == pytest.approx(end["sum_received"]["bytes"], rel=0.07)
    assert values["iperf3_jitter_s"] == pytest.approx(end["sum"]["jitter_ms"] / 1e3, rel=1e-3)


@pytest.mark.parametrize("version", VERSIONS)
def test_the_counts_of_a_tcp_test_with_two_streams_agree(version: str) -> None:
    values = measure_values(version, "tcp")
    end = json.loads(output(version, "tcp", "client"))["end"]
    assert values["iperf3_sent_bytes"] == end["sum_sent"]["bytes"]
    assert values["iperf3_retransmits"] == end["sum_sent"]["retransmits"]
    assert values["iperf3_received_bytes"] == end["sum_received"]["bytes"]
    assert values["iperf3_throughput_bit_s"] == pytest.approx(end["sum_received"]["bits_per_second"], rel=0.15)
    assert not {"iperf3_loss", "iperf3_datagrams_sent", "iperf3_jitter_s"} & values.keys()
    ports = [iperf3.parse(output(version, "tcp", end_name)).ports for end_name in ("client", "server")]
    assert len(ports[0]) == 2
    assert ports[0] == tuple((client_port, server_port) for server_port, client_port in ports[1])


@pytest.mark.parametrize("version", VERSIONS)
def test_a_test_that_did_not_start_has_an_error(version: str) -> None:
    result = iperf3.parse(output(version, "refused", "client"))
    assert "Connection refused" in result.error
    assert result.intervals == ()


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_truncated_json_is_an_error(version: str, share: float) -> None:
    text = output(version, "udp", "server")
    with pytest.raises(EvidenceError, match="or was truncated"):
        iperf3.parse(text[: int(share * len(text))])


def test_text_before_the_json_and_invalid_numbers_are_accepted() -> None:
    text = output("3.1.3", "udp", "server").replace('"lost_percent":\t', '"lost_percent":\t-nan, "x":\t', 1)
    assert "nan" in text
    with pytest.raises(ValueError, match="Expecting value"):
        json.loads(text)
    assert iperf3.parse(text) == iperf3.parse(output("3.1.3", "udp", "server"))
    assert iperf3.parse(f"warning: old\n{text}").intervals


@pytest.mark.parametrize("text", ["[]", "{}", '"start"', "12", '{"a": 1}', 5000 * '{"start":', 5000 * "["])
def test_other_json_is_an_error(text: str) -> None:
    with pytest.raises(EvidenceError):
        iperf3.parse(text)


def test_omitted_intervals_are_not_counted() -> None:
    data = json.loads(output("3.12", "udp", "server"))
    intervals = iperf3.parse(json.dumps(data)).intervals
    data["intervals"][0]["sum"]["omitted"] = True
    assert iperf3.parse(json.dumps(data)).intervals == intervals[1:]


def test_the_output_of_one_end_gives_only_its_columns() -> None:
    sender = iperf3.parse(output("3.12", "udp", "client"))
    result = iperf3.measure(Protocol.UDP, sender, None)
    assert set(result.values) == {"iperf3_sent_bytes"}
    assert result.missing["iperf3_throughput_bit_s"]


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                ["sum", "seconds", "bytes", "packets", "lost_packets", "jitter_ms", "retransmits", "error"]
            ),
            inner,
            max_size=4,
        )
    ),
    max_leaves=20,
)


@given(
    intervals=st.lists(VALUES | st.fixed_dictionaries({"sum": VALUES}), max_size=4),
    end=VALUES,
    connected=VALUES,
    protocol=st.sampled_from(Protocol),
)
def test_any_output_gives_only_possible_values(
    intervals: object, end: object, connected: object, protocol: Protocol
) -> None:
    text = json.dumps({"start": {"connected": connected}, "intervals": intervals, "end": end})
    test = iperf3.parse(text)
    result = iperf3.measure(protocol, test, test)
    for column in iperf3.COLUMNS:
        if column.name in result.values:
            value = result.values[column.name]
            assert isinstance(value, int | float)
            assert math.isfinite(value)
            assert column.invalid_value_reason(str(value)) is None or value > 1e15, (column.name, value)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "sender-iperf3.json"
    with path.open("wb") as file:
        file.truncate((16 << 20) + 1)
    with pytest.raises(EvidenceError, match="longer than 16 MiB"):
        iperf3.read(path)

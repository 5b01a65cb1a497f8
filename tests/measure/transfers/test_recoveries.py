"""Recovery of flows after faults, from given deliveries and times of faults."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.robot_clock import Offset
from fieldkit.measure.transfers import recoveries
from fieldkit.measure.transfers.deliveries import StreamDeliveries
from fieldkit.measure.transfers.recoveries import FaultTimes

MS = 1_000_000
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
KIND = FaultKind.LINK_DOWN
ROBOT = Role.RECEIVER


def make_stream(*at_ms: int, begin_ms: int = 0, end_ms: int | None = None) -> StreamDeliveries:
    at_ns = START + MS * np.array(at_ms, dtype=np.int64)
    return StreamDeliveries(at_ns, START + begin_ms * MS, None if end_ms is None else START + end_ms * MS, 0.0, 0.2)


def times(began_ms: int, ended_ms: int | None, ahead_s: float = 0.0, error_s: float = 0.001) -> FaultTimes:
    """Return the times of a fault by the laptop's clock. The robot's clock is ahead by `ahead_s`."""
    began_ns, ended_ns = (
        None if time_ms is None else START + time_ms * MS - round(ahead_s * 1e9) for time_ms in (began_ms, ended_ms)
    )
    assert began_ns is not None
    return FaultTimes(began_ns, ended_ns, {ROBOT: Offset(ahead_s, error_s)})


def measure_values(fault_times: FaultTimes | None, *streams: StreamDeliveries) -> dict[str, Any]:
    result = recoveries.measure("transfer", KIND, lambda: streams, fault_times, ROBOT)
    recovery_names = {column.name for column in recoveries.declare_columns("transfer", KIND)}
    assert result.values.keys() | result.missing.keys() == recovery_names
    assert not result.values.keys() & result.missing.keys()
    return {name.removeprefix("transfer_link_down_"): value for name, value in result.values.items()}


@given(
    before_ms=st.lists(st.integers(1, 999), min_size=1),
    recovery_ms=st.integers(1, 20_000),
    ahead_s=st.integers(-86_400, 86_400),
)
def test_recovery_starts_at_the_end_of_the_fault_for_any_clock_offset(
    before_ms: list[int], recovery_ms: int, ahead_s: int
) -> None:
    stream = make_stream(*sorted(before_ms), 3000 + recovery_ms, 3000 + recovery_ms + 10)
    result = measure_values(times(1000, 3000, float(ahead_s)), stream)
    assert result["recovery_s"] == pytest.approx(recovery_ms / 1e3, abs=1e-6)
    assert result["outage_s"] == pytest.approx((3000 + recovery_ms - max(before_ms)) / 1e3, abs=1e-6)


def test_an_unaffected_flow_recovers_with_its_next_payload() -> None:
    result = measure_values(times(1000, 3000), make_stream(*range(0, 5000, 20)))
    assert result == {"recovery_s": pytest.approx(0.02), "outage_s": pytest.approx(0.02)}


def test_a_flow_that_does_not_recover_has_lower_bounds() -> None:
    result = measure_values(times(1000, 3000), make_stream(0, 500, 900, end_ms=9000))
    assert result == {"recovery_at_least_s": pytest.approx(6.0), "outage_at_least_s": pytest.approx(8.1)}


def test_a_flow_that_ended_during_the_fault_has_only_an_outage() -> None:
    result = measure_values(times(1000, 3000), make_stream(0, 900, end_ms=2000))
    assert result == {"outage_at_least_s": pytest.approx(1.1)}


def test_the_last_of_several_streams_to_recover_counts() -> None:
    recovered, unrecovered = make_stream(0, 900, 3100), make_stream(0, 900, end_ms=5000)
    assert measure_values(times(1000, 3000), recovered, make_stream(0, 950, 3900))["recovery_s"] == pytest.approx(0.9)
    assert measure_values(times(1000, 3000), recovered, unrecovered) == {
        "recovery_at_least_s": pytest.approx(2.0),
        "outage_at_least_s": pytest.approx(4.1),
    }


def test_a_flow_that_was_being_set_up_has_an_outage_from_its_start() -> None:
    result = measure_values(times(1000, 3000), make_stream(4000, 4010, begin_ms=500))
    assert result == {"recovery_s": pytest.approx(1.0), "outage_s": pytest.approx(3.5)}


def test_a_fault_with_an_unknown_end_has_only_an_outage() -> None:
    result = measure_values(times(1000, None), make_stream(0, 990, 4000, 4010))
    assert result == {"outage_s": pytest.approx(3.01)}


@pytest.mark.parametrize(
    ("fault_times", "stream"),
    [
        (None, make_stream(0, 4000)),
        (times(1000, 3000, error_s=0.2), make_stream(0, 4000)),
        (FaultTimes(START, START, {}), make_stream(0, 4000)),
        (times(1000, 3000), make_stream()),
        (times(1000, 3000), make_stream(4000, 4010, begin_ms=3900)),
        (times(1000, 3000), make_stream(0, 900)),
        (times(1000, 3000), make_stream(0, 500, 2000)),
        (times(1000, 3000), make_stream(0, 900, end_ms=950)),
    ],
)
def test_flows_outside_the_fault_or_without_times_have_no_recovery(
    fault_times: FaultTimes | None, stream: StreamDeliveries
) -> None:
    assert not measure_values(fault_times, stream)


@given(
    st.integers(0, 2**63 - 1),
    st.none() | st.integers(0, 2**63 - 1),
    st.dictionaries(st.sampled_from([Role.SENDER, Role.RECEIVER, Role.RELAY]), st.integers(-(10**9), 10**9)),
)
def test_times_of_faults_are_written_and_read(
    began_ns: int, ended_ns: int | None, offsets_us: dict[Role, int]
) -> None:
    written = FaultTimes(
        began_ns, ended_ns, {role: Offset(offset_us / 1e6, 0.25) for role, offset_us in offsets_us.items()}
    )
    text = recoveries.fault_times_text(written)
    parsed = recoveries.parse_fault_times(text)
    assert (parsed.began_ns, parsed.ended_ns, parsed.clock_offsets.keys()) == (began_ns, ended_ns, offsets_us.keys())
    for role, offset in parsed.clock_offsets.items():
        assert offset.offset_s == pytest.approx(written.clock_offsets[role].offset_s, abs=1e-9)


@pytest.mark.parametrize(
    "text", ["", "began_utc_ns 1\n", "began_utc_ns x\nended_utc_ns 2\n", "began_utc_ns 1\nended_utc_ns 2\nx\n"]
)
def test_a_truncated_file_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "times.txt").write_text(text, encoding="ascii")
    with pytest.raises(EvidenceError, match="does not contain the start and end of the fault"):
        recoveries.read_fault_times(tmp_path / "times.txt")

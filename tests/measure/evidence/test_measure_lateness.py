"""Lateness files of a testbed: writing, reading, damaged files, and columns."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Lateness
from fieldkit.measure.evidence import oracle_delays
from sim_backends.emulated.medium.ports import round_up
from tests.helpers.measures import Measures, measure

TEXT = "bound 5000\nlate 1000 98\nlate 6000 1\nlate 8000 1\n"
COUNTS = st.dictionaries(st.integers(1, 10**12), st.integers(1, 50), max_size=20)


def write_file(folder: Path, content: bytes) -> Path:
    path = folder / "lateness.txt"
    path.write_bytes(content)
    return path


def test_columns_are_computed_from_a_file(tmp_path: Path) -> None:
    write_file(tmp_path, TEXT.encode())
    assert measure(tmp_path, None) == Measures(
        emulator_late_p99_s=6e-6, emulator_late_max_s=8e-6, emulator_too_late=2
    )


def test_without_packets_there_is_no_lateness(tmp_path: Path) -> None:
    write_file(tmp_path, b"bound 5000\n")
    assert measure(tmp_path, None) == Measures(emulator_too_late=0)


@pytest.mark.parametrize(
    "content",
    [
        "",
        TEXT[:-1],
        TEXT + TEXT,
        TEXT.replace("bound", "late"),
        TEXT.replace("bound 5000\n", ""),
        TEXT.replace(" 98", " -98"),
        TEXT.replace(" 98", " 9.8"),
        TEXT.replace(" 98", " " + "9" * 19),
    ],
)
def test_invalid_contents_are_refused(tmp_path: Path, content: str) -> None:
    path = write_file(tmp_path, content.encode())
    with pytest.raises(EvidenceError):
        oracle_delays.read_lateness(path)
    assert measure(tmp_path, None) == Measures()


@given(earlier_packets=COUNTS, new_packets=COUNTS, bound_ns=st.integers(1, 10**12))
def test_packets_between_two_readings_are_written_and_read(
    tmp_path_factory: pytest.TempPathFactory,
    earlier_packets: dict[int, int],
    new_packets: dict[int, int],
    bound_ns: int,
) -> None:
    first = Lateness(bound_ns=bound_ns, packets=earlier_packets)
    second = Lateness(bound_ns=bound_ns, packets=Counter(earlier_packets) + Counter(new_packets))
    path = write_file(tmp_path_factory.getbasetemp(), oracle_delays.lateness_text(first, second).encode())
    assert oracle_delays.read_lateness(path) == Lateness(bound_ns=bound_ns, packets=new_packets)


@given(st.integers(0, 10**6))
def test_a_truncated_file_is_refused(tmp_path_factory: pytest.TempPathFactory, end: int) -> None:
    lateness = Lateness(bound_ns=5000, packets={1000: 98, 6000: 1, 8000: 1})
    content = oracle_delays.lateness_text(Lateness(bound_ns=5000, packets={}), lateness).encode()
    path = write_file(tmp_path_factory.getbasetemp(), content[: end % len(content)])
    with pytest.raises(EvidenceError):
        oracle_delays.read_lateness(path)


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=300), st.floats(0.01, 1.0))
def test_quantiles_equal_the_rounded_quantiles_of_all_packets(lateness_ns: list[int], share: float) -> None:
    lateness = Lateness(bound_ns=1, packets=Counter(map(round_up, lateness_ns)))
    quantile_ns = oracle_delays.lateness_quantile_ns(lateness.packets, share)
    true_ns = int(np.quantile(lateness_ns, share, method="inverted_cdf"))
    assert quantile_ns is not None
    assert true_ns < quantile_ns <= true_ns * 9 / 8 + 1


@given(st.sets(st.integers(0, 2**40), min_size=1))
def test_rounded_lateness_has_few_values(lateness_ns: set[int]) -> None:
    assert len({round_up(value) for value in lateness_ns}) <= 8 * 41

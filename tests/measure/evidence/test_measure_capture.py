import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.evidence import tcpdump_log
from fieldkit.measure.evidence.tcpdump_log import CaptureLog
from tests.helpers.captures import TCPDUMP

WITHOUT_COUNTS = CaptureLog(False, None, None, None, None)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("normal", CaptureLog(True, 42, 84, 0, 0)),
        ("one-packet", CaptureLog(True, 1, 4, 0, 0)),
        ("any", CaptureLog(True, 1, 4, 0, 0)),
        ("nothing", CaptureLog(True, 0, 0, 0, 0)),
        ("dropped", CaptureLog(True, 29_484, 1_440_000, 1_311_884, 0)),
        ("killed", CaptureLog(True, None, None, None, None)),
        ("no-device", WITHOUT_COUNTS),
        ("no-right", WITHOUT_COUNTS),
        ("bad-filter", WITHOUT_COUNTS),
        ("../4.9/limited", CaptureLog(True, 100, 114, 0, 0)),
    ],
)
def test_real_logs_are_parsed(name: str, expected: CaptureLog) -> None:
    assert tcpdump_log.read(TCPDUMP / f"{name}.log") == expected


def test_drops_of_the_interface_are_parsed_if_present() -> None:
    log = (TCPDUMP / "normal.log").read_text(encoding="utf-8") + "1 packet dropped by interface\n"
    assert tcpdump_log.parse(log).dropped_by_interface == 1


def test_counters_are_parsed_after_progress_and_an_echoed_interrupt() -> None:
    assert tcpdump_log.parse("^C5 packets captured\n").captured == 5
    assert tcpdump_log.parse("Got 4\r5 packets captured\n").captured == 5


@given(st.text())
def test_any_text_raises_no_error(text: str) -> None:
    tcpdump_log.parse(text)

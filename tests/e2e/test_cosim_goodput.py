"""`fieldkit cosim goodput`: predictions of logged links, rows without a prediction, and wrong logs."""

import json
from pathlib import Path

import pytest

from sim_backends.cosim.commands.goodput import read_log
from sim_backends.cosim.studies.link_goodput import LoggedLink
from tests.e2e.test_cosim_run import cosim

HEAD = "signal_dbm,standard,width_mhz,mcs,protocol,goodput_bit_s"


def write_log(tmp_path: Path, *rows: str, head: str = HEAD) -> Path:
    log = tmp_path / "links.csv"
    log.write_text("\n".join((head, *rows)) + "\n")
    return log


def test_predictions_are_compared_with_measurements(tmp_path: Path) -> None:
    log = write_log(
        tmp_path,
        "-50,802.11n 2.4 GHz,20,7.0,udp,50e6",
        "-50.1,802.11n 2.4 GHz,20,7,udp,",
        ",802.11n 2.4 GHz,20,7,udp,50e6",
        "-50,802.11n 2.4 GHz,160,7,udp,50e6",
    )
    completed = cosim(tmp_path, "goodput", str(log), "--format", "json")
    assert completed.code == 0, completed.err
    sheets = json.loads(completed.out)
    first, second, without_signal, too_wide = sheets["links"]
    # 64 frames of 1,532 bytes at 65 Mbit/s last 12.1 ms; preamble, backoff, spaces and block ACK last 0.2 ms.
    assert first["predicted_goodput_bit_s"] == pytest.approx(60e6, rel=0.02)
    assert second["predicted_goodput_bit_s"] == first["predicted_goodput_bit_s"], "signals are rounded to 0.5 dB"
    assert first["error"] == pytest.approx(first["predicted_goodput_bit_s"] / 50e6 - 1)
    assert (second["error"], without_signal["predicted_goodput_bit_s"]) == (None, None)
    assert (too_wide["predicted_goodput_bit_s"], "160 MHz" in too_wide["reason"]) == (None, True)
    narrow, wide = sheets["errors"]
    assert (narrow["width_mhz"], narrow["rows"], narrow["compared"]) == (20, 2, 1)
    assert narrow["median_error"] == narrow["p90_error"] == pytest.approx(first["error"])
    assert (wide["width_mhz"], wide["rows"], wide["compared"], wide["mean_error"]) == (160, 1, 0, None)
    assert "no prediction for 1 row: the log has no signal" in completed.err


def test_a_measurement_above_the_phy_rate_shows_that_the_rate_is_of_another_time(tmp_path: Path) -> None:
    log = write_log(tmp_path, "-50,802.11n 2.4 GHz,20,7,tcp,66e6", "-50,802.11n 2.4 GHz,20,7,tcp,64e6")
    completed = cosim(tmp_path, "goodput", str(log))
    assert "the measured goodput of 1 row exceeds the PHY rate" in completed.err
    assert "ht20-mcs7-1ss-800ns" in completed.out
    assert "protocol" not in completed.out.split("errors of the predictions")[0], "all rows have the same protocol"


@pytest.mark.parametrize(
    ("rows", "head", "expected"),
    [
        ((), HEAD, "the log has no rows"),
        (("-50,x",), "rssi,standard", "there is no column signal_dbm"),
        (("-50", "-5O"), "signal_dbm", "links.csv:3: signal_dbm is '-5O'"),
        (("-50,7.5",), "signal_dbm,mcs", "links.csv:2: mcs is '7.5'"),
        (("-50,sctp",), "signal_dbm,protocol", "the protocol 'sctp' is unknown"),
        (("-50,802.11be",), "signal_dbm,standard", "the standard '802.11be' is unknown"),
        (("-50,5,2e7",), "signal_dbm,goodput_bit_s", "links.csv:2: 3 cells in a table of 2 columns"),
        (("-50,7", "-50"), "signal_dbm,mcs", "links.csv:3: 1 cells in a table of 2 columns"),
        (("-50;7",), "signal_dbm;mcs", "separate the cells by commas"),
        (("-50,-60",), "signal_dbm,signal_dbm", "two columns have the name signal_dbm"),
        (("1e308",), "signal_dbm", "links.csv:2: signal_dbm is '1e308'"),
        (("-50,1e9",), "signal_dbm,streams", "links.csv:2: streams is '1e9'"),
        (("-50,-1",), "signal_dbm,goodput_bit_s", "links.csv:2: goodput_bit_s is '-1'"),
        (("-50,1e308",), "signal_dbm,goodput_bit_s", "write a number from 0 to 1e+12"),
        (("60",), "signal_dbm", "signals below -90.2 dBm or above 9.8 dBm are not modelled at 2.4 GHz"),
        (("-99,802.11a,6e6",), "signal_dbm,standard,phy_rate_bit_s", "signals below -96"),
    ],
)
def test_wrong_logs_are_errors(tmp_path: Path, rows: tuple[str, ...], head: str, expected: str) -> None:
    log = write_log(tmp_path, *rows, head=head)
    completed = cosim(tmp_path, "goodput", str(log))
    assert (completed.code, expected in completed.err) == (2, True), completed.err


def test_a_log_of_a_spreadsheet_is_read_as_any_other(tmp_path: Path) -> None:
    log = tmp_path / "links.csv"
    log.write_bytes("\ufeffsignal_dbm , mcs, goodput_bit_s\r\n-50,7,1e-310\r\n\r\n".encode())
    (row,) = read_log(log)
    assert (row.line, row.link, row.measured_bit_s) == (2, LoggedLink(-50, mcs=7), 1e-310)
    completed = cosim(tmp_path, "goodput", "links.csv", "--format", "json")
    assert (completed.code, json.loads(completed.out)["links"][0]["error"]) == (0, None), completed.err

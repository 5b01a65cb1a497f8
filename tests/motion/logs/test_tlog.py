"""Telemetry logs: values of given messages, and logs that are truncated, damaged, or of other systems."""

import json
import random
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as d

from fieldkit.core.errors import EvidenceError
from fieldkit.motion.logs import periodic, tlog, tlog_reader
from fieldkit.motion.logs.periodic import StreamMessage
from tests.helpers.drones import Sender, beat, flight, stamped


def write_log(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "x.tlog"
    path.write_bytes(data)
    return path


def measure_values(tmp_path: Path, data: bytes, ended_us: int = 0) -> dict[str, object]:
    measured_log = tlog.measure(tlog.read(write_log(tmp_path, data), 0, ended_us))
    assert measured_log.values.keys() | measured_log.missing.keys() == {column.name for column in tlog.COLUMNS}
    return dict(measured_log.values)


def test_the_columns_of_a_flight_are_correct(tmp_path: Path) -> None:
    values = measure_values(tmp_path, flight(10, 1.5))
    assert values["mavlink_messages"] == values["mavlink_sent"] == 1 + 2 * 101
    assert values["mavlink_loss"] == values["mavlink_damaged"] == 0
    assert values["mavlink_armed"] is True
    assert (values["mavlink_north_begin_m"], values["mavlink_north_end_m"]) == (0, 15)
    assert values["mavlink_speed_mean_m_s"] == values["mavlink_speed_max_m_s"] == 1.5
    assert [values[f"mavlink_height_{statistic}_m"] for statistic in ("min", "mean", "max")] == [3, 3, 3]
    assert values["mavlink_roll_max_deg"] == pytest.approx(5.73, abs=0.01)
    assert values["mavlink_pitch_min_deg"] == pytest.approx(-11.46, abs=0.01)
    assert "mavlink_lat_begin_deg" not in values


def test_battery_position_and_radio_link_are_measured(tmp_path: Path) -> None:
    sender, radio = Sender(), Sender(51, 68)
    sensors = (0, 0, 0, 200)
    messages = [
        sender.frame(beat()),
        sender.frame(d.MAVLink_sys_status_message(*sensors, 12_600, 100, 90, 0, 0, 0, 0, 0, 0)),
        sender.frame(
            d.MAVLink_global_position_int_message(0, 481_374_000, 115_755_000, 500_000, 2_000, 300, 400, -100, 0)
        ),
        radio.frame(d.MAVLink_radio_status_message(180, 150, 90, 40, 45, 0, 0)),
        radio.frame(d.MAVLink_radio_status_message(255, 255, 90, 40, 45, 0, 0)),
        sender.frame(d.MAVLink_sys_status_message(*sensors, 11_100, 100, 42, 250, 0, 0, 0, 0, 0)),
        sender.frame(d.MAVLink_sys_status_message(*sensors, 65_535, 100, -1, 0, 0, 0, 0, 0, 0)),
    ]
    values = measure_values(tmp_path, stamped([(number, message) for number, message in enumerate(messages)]))
    assert (values["mavlink_battery_begin"], values["mavlink_battery_end"]) == (0.9, 0.42)
    assert (values["mavlink_battery_begin_v"], values["mavlink_battery_end_v"]) == (12.6, 11.1)
    assert (values["mavlink_lat_begin_deg"], values["mavlink_lon_end_deg"]) == (48.1374, 11.5755)
    assert (values["mavlink_height_max_m"], values["mavlink_speed_max_m_s"]) == (2, 5)
    assert values["mavlink_climb_max_m_s"] == 1
    assert (values["mavlink_drop_rate"], values["mavlink_rssi_min"]) == (0.025, 150)
    assert values["mavlink_messages"] == 5
    assert values["mavlink_armed"] is False


def test_the_loss_is_a_share_of_the_sent_messages(tmp_path: Path) -> None:
    values = measure_values(tmp_path, flight(10, lost=lambda number: number % 10 == 5))
    assert (values["mavlink_messages"], values["mavlink_sent"]) == (183, 203)
    assert values["mavlink_loss_most"] == pytest.approx(20 / 203)
    assert (values["mavlink_periodic"], values["mavlink_periodic_sent"]) == (182, 202)
    assert values["mavlink_loss"] == pytest.approx(20 / 202)


def test_sequence_numbers_filtered_by_a_router_count_only_in_the_upper_bound(tmp_path: Path) -> None:
    sender, frames = Sender(), [(0, Sender().frame(beat()))]
    sender.link.seq = 1
    for number in range(200):
        frames.append((100_000 * number, sender.frame(d.MAVLink_attitude_message(100 * number, 0, 0, 0, 0, 0, 0))))
        if number % 20 == 10:
            sender.frame(d.MAVLink_command_ack_message(511, 0))  # to another station
    values = measure_values(tmp_path, stamped(frames))
    assert values["mavlink_loss"] == 0
    assert values["mavlink_loss_most"] == pytest.approx(10 / 211)


def test_a_log_without_a_periodic_stream_has_only_the_upper_bound(tmp_path: Path) -> None:
    sender = Sender()
    values = measure_values(tmp_path, stamped([(1_000_000 * number, sender.frame(beat())) for number in range(20)]))
    assert values["mavlink_loss_most"] == 0
    assert "mavlink_loss" not in values


def test_a_damaged_frame_is_counted_and_lost(tmp_path: Path) -> None:
    data = bytearray(flight(1))
    data[60] ^= 1
    values = measure_values(tmp_path, bytes(data))
    assert (values["mavlink_damaged"], values["mavlink_sent"]) == (1, 23)
    assert values["mavlink_messages"] == 22


def test_impossible_values_are_missing(tmp_path: Path) -> None:
    sender = Sender()
    messages = [
        beat(),
        d.MAVLink_local_position_ned_message(0, float("nan"), 1e30, float("inf"), 1e20, 0, float("nan")),
        d.MAVLink_attitude_message(0, 1e30, float("nan"), 0, 0, 0, 0),
    ]
    values = measure_values(tmp_path, stamped([(0, sender.frame(message)) for message in messages]))
    assert not {message for message in values if message.endswith(("_m", "_m_s", "_deg"))}


@pytest.mark.parametrize("version", ["old", "signed"])
def test_logs_of_mavlink_1_and_of_signed_frames_are_read(version: str, tmp_path: Path) -> None:
    sender = Sender()
    if version == "signed":
        sender.link.signing.secret_key, sender.link.signing.sign_outgoing = b"k" * 32, True
    messages = [beat(), *(d.MAVLink_attitude_message(at, 0.5, 0, 0, 0, 0, 0) for at in range(5))]
    frames = []
    for number, message in enumerate(messages):
        frames.append((number, bytes(message.pack(sender.link, force_mavlink1=version == "old"))))
        sender.link.seq = number + 1
    assert {message[0] for _, message in frames} == {0xFE if version == "old" else 0xFD}
    values = measure_values(tmp_path, stamped(frames))
    assert (values["mavlink_messages"], values["mavlink_sent"], values["mavlink_damaged"]) == (6, 6, 0)
    assert values["mavlink_roll_max_deg"] == pytest.approx(28.65, abs=0.01)


def test_one_of_two_autopilots_must_be_named(tmp_path: Path) -> None:
    frames = [(0, Sender(system).frame(beat())) for system in (3, 4)]
    path = write_log(tmp_path, stamped(frames))
    with pytest.raises(EvidenceError, match="autopilots of systems 3, 4: choose one"):
        tlog.read(path, 0, 0)
    assert tlog.read(path, 4, 0).frames == 2
    with pytest.raises(EvidenceError, match="no heartbeat from an autopilot of system 5"):
        tlog.read(path, 5, 0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "no heartbeat from an autopilot"),
        (b"\0" * 40, "no frame starts at offset 8"),
        (flight(1)[:-1], "it is truncated after"),
        (flight(1) + b"\0" * 9, "it is truncated after"),
        (b"\xff" + flight(1)[1:], "is after the year 2112"),
        (stamped([(0, Sender().frame(d.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)))]), "no heartbeat"),
    ],
)
def test_an_incomplete_log_is_refused(data: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match=message):
        tlog.read(write_log(tmp_path, data), 0, 0)


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError):
        tlog.read(tmp_path / "none.tlog", 0, 0)


@given(st.integers(0, len(flight(1)) - 1))
def test_a_truncated_log_has_only_complete_frames_or_is_refused(end: int) -> None:
    data = flight(1)[:end]
    try:
        frames = list(tlog_reader.frames(data))
    except ValueError:
        return
    assert sum(8 + len(message.data) for message in frames) == end


@given(st.binary(max_size=300), st.integers(0, 2**40))
def test_any_bytes_are_refused_or_read(data_after: bytes, at_us: int) -> None:
    for data in (data_after, stamped([(at_us, Sender().frame(beat()))]) + data_after):
        for request in ({"ended_us": 0, "intervals_us": {}}, {"positions": tlog.LOCAL}, {"positions": tlog.GLOBAL}):
            with suppress(ValueError):  # other errors are not expected
                _read_by_question(data, request)


def _read_by_question(data: bytes, request: Mapping[str, object]) -> object:
    autopilot = tlog_reader._autopilot(data, 0)
    if "positions" in request:
        return list(tlog_reader._positions(data, autopilot, str(request["positions"])))
    return json.dumps(tlog_reader._summary(data, autopilot, 0, {}))


COUNTERS = {"frames": 3, "bytes": 99, "left_out": 0, "ended_us": 5, "refused": {"32": 2}}


def test_the_summary_of_a_recorder_is_read(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.json"
    path.write_text(json.dumps(COUNTERS), encoding="utf-8")
    assert tlog.read_summary(path) == tlog.RecorderSummary(3, 0, 5, {32: 2})


INVALID_COUNTERS: list[dict[str, object]] = [
    {"frames": -1},
    {"frames": 1.5},
    {"frames": True},
    {"left_out": None},
    {"refused": []},
    {"refused": {"x": 1}},
]


@pytest.mark.parametrize(
    "recorder_summary",
    [
        "",
        "[]",
        "7",
        "[" * 5000,
        *(json.dumps({**COUNTERS, **invalid_counters}) for invalid_counters in INVALID_COUNTERS),
    ],
)
def test_an_invalid_summary_is_refused(recorder_summary: str, tmp_path: Path) -> None:
    path = tmp_path / "mavlink.json"
    path.write_text(recorder_summary, encoding="utf-8")
    with pytest.raises(EvidenceError, match="is not a summary of a recording"):
        tlog.read_summary(path)


def test_a_log_that_contradicts_its_recorder_or_the_attempt_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.tlog"
    path.write_bytes(flight())
    log = tlog.read(path, 0, 0)
    recorder_summary = tlog.RecorderSummary(log.frames, 0, log.last_us + 5, {}, tlog.crc32_of(path))
    window = log.first_us * 1000, log.last_us * 1000 + 999
    assert list(tlog.contradictions(log, recorder_summary, tlog.crc32_of(path), window)) == []
    for summary, checksum, attempt_window, expected_reason in (
        (recorder_summary, 7, window, "its checksum differs"),
        (
            replace(recorder_summary, ended_us=log.last_us - 10**6),
            tlog.crc32_of(path),
            window,
            "1.000 s after its recorder stopped",
        ),
        (
            recorder_summary,
            tlog.crc32_of(path),
            (window[0] + 10**9, window[1]),
            "from before the attempt or after it",
        ),
        (
            recorder_summary,
            tlog.crc32_of(path),
            (window[0], window[1] - 10**9),
            "from before the attempt or after it",
        ),
    ):
        (reason,) = tlog.contradictions(log, summary, checksum, attempt_window)
        assert expected_reason in reason


def test_repeated_frames_are_detected(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.tlog"
    content = flight()
    path.write_bytes(content + content)
    log = tlog.read(path, 0, 0)
    (reason,) = tlog.contradictions(log, tlog.RecorderSummary(log.frames, 0, log.last_us, {}), 0, None)
    assert "a frame that is 10.001 s earlier than the previous one" in reason


@given(st.floats(0, 0.3), st.integers(0, 2**32))
def test_random_loss_is_measured_even_if_a_router_filters_messages(share: float, seed: int) -> None:
    random_generator = random.Random(seed)
    numbers, streams, n_lost = list[tuple[int, int]](), dict[str, list[StreamMessage]](), 0
    n_sent = 0
    for slot in range(400):
        for name in ("ATTITUDE", "LOCAL_POSITION_NED"):
            n_sent += 1 + (
                random_generator.random() < 0.02
            )  # an answer to another station also has a sequence number
            if 0 < slot < 399 and random_generator.random() < share:
                n_lost += 1
                continue
            numbers.append((100_000 * slot, n_sent % 256))
            streams.setdefault(name, []).append(StreamMessage(100_000 * slot, 100 * slot, len(numbers) - 1))
    n_arrived, counted_losses = periodic.count_messages(numbers, streams, 0)
    assert (n_arrived, counted_losses) == (len(numbers), n_lost)

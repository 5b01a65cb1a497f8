"""The timeline of a trial, read with the MCAP library by index and as a stream; messages conform to their schemas."""

import io
import json
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from mcap.reader import NonSeekingReader, make_reader

from fieldkit.cli import main
from fieldkit.core.model import LinkSample, Role, StationSample, TrackPoint
from fieldkit.measure.evidence import link_samples, track
from fieldkit.trial import journal
from tests.helpers import recorded
from tests.helpers.captures import file_bytes, timed
from tests.helpers.recorded import AHEAD_NS, LOST, PACKETS, REPEATED, RTT_MS, SECOND_NS, START_NS

BEGIN_NS = START_NS + 10 * SECOND_NS


@dataclass(frozen=True)
class ReadMessage:
    """A message that was read from an exported file."""

    topic: str
    time_ns: int
    content: dict[str, Any]
    schema: dict[str, Any]
    clock: str


def export(trial: Path, name: str = "out.mcap") -> bytes:
    out = trial.parent / name
    assert main(["export", str(trial), "--format", "mcap", "-o", str(out)]) == 0
    return out.read_bytes()


def messages(file: bytes) -> list[ReadMessage]:
    read_messages = []
    for schema, channel, message in make_reader(io.BytesIO(file), validate_crcs=True).iter_messages():
        assert schema
        content, form = json.loads(message.data), json.loads(schema.data)
        read_messages.append(ReadMessage(channel.topic, message.log_time, content, form, channel.metadata["clock"]))
    return read_messages


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a trial that tests must not change."""
    return recorded.make(tmp_path_factory.mktemp("trials"))


@pytest.fixture
def trial(original: Path, tmp_path: Path) -> Path:
    """Return a copy of that trial, which a test may change."""
    return Path(shutil.copytree(original, tmp_path / original.name))


@pytest.fixture(scope="module")
def read_messages(original: Path) -> list[ReadMessage]:
    return messages(export(original))


def messages_of(read_messages: list[ReadMessage], topic: str) -> list[ReadMessage]:
    return [message for message in read_messages if message.topic == topic]


def test_every_message_conforms_to_its_schema_and_has_its_own_time(read_messages: list[ReadMessage]) -> None:
    for message in read_messages:
        jsonschema.validate(message.content, message.schema)
        stamp = (
            message.content["transforms"][0]["timestamp"] if message.topic == "/tf" else message.content["timestamp"]
        )
        assert stamp["sec"] * SECOND_NS + stamp["nsec"] == message.time_ns
        assert message.content.keys() <= message.schema["properties"].keys(), "a field that is not in the schema"


def test_the_index_the_statistics_and_the_stream_agree(trial: Path) -> None:
    content = export(trial)
    reader = make_reader(io.BytesIO(content))
    summary = reader.get_summary()
    assert summary
    assert summary.statistics
    indexed_times, streamed_times = (
        [(channel.topic, message.log_time) for _, channel, message in each_reader.iter_messages()]
        for each_reader in (reader, NonSeekingReader(io.BytesIO(content)))
    )
    assert sorted(indexed_times) == sorted(streamed_times)
    times = [time_ns for _, time_ns in indexed_times]
    assert times == sorted(times)
    assert summary.statistics.message_count == len(indexed_times)
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (times[0], times[-1])
    counts = {
        summary.channels[channel_id].topic: count
        for channel_id, count in summary.statistics.channel_message_counts.items()
    }
    assert counts == Counter(topic for topic, _ in indexed_times)
    assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"json"}
    (trial_metadata,) = reader.iter_metadata()
    assert trial_metadata.metadata["trial"] == trial.name


def test_the_log_has_the_entries_of_the_journal(read_messages: list[ReadMessage], trial: Path) -> None:
    lines = (trial / journal.JOURNAL_FILE).read_text(encoding="utf-8").splitlines()
    entries = [
        (message.content["level"], message.content["name"], message.content["message"])
        for message in messages_of(read_messages, "/trial/log")
    ]
    assert entries == [
        (2, "udp-01", "attempt 1 running"),
        (3, "udp-01", "attempt 1 void: ping.txt is missing"),
        (2, "udp-01", "attempt 2 running"),
        (2, "udp-01", "attempt 2 valid"),
    ]
    for message in messages_of(read_messages, "/trial/log"):
        entry = json.loads(lines[message.content["line"] - 1])
        assert (message.content["file"], message.time_ns) == (journal.JOURNAL_FILE, entry["utc_ns"])


def test_each_packet_has_the_time_of_its_robot_and_its_fate(read_messages: list[ReadMessage]) -> None:
    sent_messages, received_messages = (
        messages_of(read_messages, "/sender/packets"),
        messages_of(read_messages, "/receiver/packets"),
    )
    first_ns = BEGIN_NS + 2 * SECOND_NS
    assert [message.time_ns for message in sent_messages] == [
        first_ns + 1_000_000 * index for index in range(PACKETS)
    ]
    assert received_messages[0].time_ns == first_ns + AHEAD_NS
    assert [index for index, message in enumerate(sent_messages) if message.content["lost"]] == list(LOST)
    assert [message.content["copy"] for message in received_messages] == [False] * (PACKETS - len(LOST)) + [True]
    assert sent_messages[REPEATED].content == {
        "timestamp": {"sec": first_ns // SECOND_NS, "nsec": 1_000_000 * REPEATED},
        "repeat": "udp-01",
        "protocol": 17,
        "source": recorded.SENDER,
        "destination": recorded.RECEIVER,
        "source_port": 40000,
        "destination_port": 1234,
        "wire_bytes": 1042,
        "payload_bytes": 1008,
        "fragment_offset": 0,
        "lost": False,
    }


def test_every_topic_names_its_clock(read_messages: list[ReadMessage]) -> None:
    assert {message.topic: message.clock for message in read_messages} == {
        "/tf": "laptop",
        "/trial/log": "laptop",
        "/repeat/udp": "laptop",
        "/sender/packets": "sender turtlebot-1",
        "/sender/phase": "sender turtlebot-1",
        "/sender/rtt": "sender turtlebot-1",
        "/sender/log": "sender turtlebot-1",
        "/receiver/packets": "receiver turtlebot-2",
        "/receiver/phase": "receiver turtlebot-2",
    }


def test_replies_and_phases_equal_those_of_the_evidence(read_messages: list[ReadMessage]) -> None:
    replies = messages_of(read_messages, "/sender/rtt")
    assert [message.content["rtt_s"] for message in replies] == [rtt_ms / 1e3 for rtt_ms in RTT_MS]
    assert [message.time_ns for message in replies] == [
        BEGIN_NS + 3 * SECOND_NS + 200_000_000 * index for index in range(3)
    ]
    assert [message.content["message"] for message in messages_of(read_messages, "/sender/log")] == [
        f"icmp_seq=4: {recorded.SENDER} reports Destination Host Unreachable"
    ]
    assert [message.content["phase"] for message in messages_of(read_messages, "/receiver/phase")] == [
        "transfer",
        "idle",
    ]
    # The bag was recorded at the start of the trial.
    starts_ns = {
        message.content["phase"]: message.time_ns
        for message in messages_of(read_messages, "/sender/phase")
        if message.content["phase"] != "idle"
    }
    assert starts_ns == {"record": START_NS, "transfer": BEGIN_NS + 2 * SECOND_NS, "ping": BEGIN_NS + 3 * SECOND_NS}


def test_the_robots_are_at_their_planned_places(read_messages: list[ReadMessage]) -> None:
    transforms = [
        transform for message in messages_of(read_messages, "/tf")[:3] for transform in message.content["transforms"]
    ]
    assert {transform["child_frame_id"]: transform["translation"] for transform in transforms} == {
        "duckiedrone-1": {"x": 0, "y": 0, "z": 0},
        "turtlebot-1": {"x": pytest.approx(-9.144), "y": 0, "z": 0},
        "turtlebot-2": {"x": pytest.approx(9.144), "y": 0, "z": 0},
    }


def test_missing_measurements_of_an_attempt_are_omitted(read_messages: list[ReadMessage]) -> None:
    void, valid = (message.content for message in messages_of(read_messages, "/repeat/udp"))
    assert (void["repeat"], void["status"], void["reason"]) == ("udp-01.void1", "void", "ping.txt is missing")
    assert "ip_loss" not in void
    assert valid["ip_loss"] == pytest.approx(len(LOST) / PACKETS)
    assert valid["rtt_max_s"] == 0.012
    assert "tcp_byte_loss" not in valid


def test_the_same_trial_gives_the_same_bytes(trial: Path) -> None:
    assert export(trial) == export(trial, "again.mcap")


def test_many_packets_are_stored_in_several_compressed_chunks(tmp_path: Path) -> None:
    content = export(recorded.make(tmp_path, packets=10_000, lost=range(0, 10_000, 10)))
    summary = make_reader(io.BytesIO(content)).get_summary()
    assert summary
    assert len(summary.chunk_indexes) > 2
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    lost_flags = [message.content["lost"] for message in messages(content) if message.topic == "/sender/packets"]
    assert (len(lost_flags), sum(lost_flags)) == (10_000, 1_000)


def test_a_damaged_capture_gives_the_packets_before_the_damage_without_fates(trial: Path) -> None:
    path = trial / "repeats" / "udp-01" / "receiver.pcap"
    path.write_bytes(path.read_bytes()[:-1])
    read_messages = messages(export(trial))
    assert len(messages_of(read_messages, "/receiver/packets")) == PACKETS - len(LOST)
    assert not any("lost" in message.content or "copy" in message.content for message in read_messages)
    (warning,) = (
        message.content
        for message in messages_of(read_messages, "/trial/log")
        if message.content["file"].endswith("receiver.pcap")
    )
    assert warning["message"].startswith("ends inside the packet at byte")
    assert warning["level"] == 3


@pytest.mark.parametrize(("payload_bytes", "has_fates"), [(1440, True), (2880, False)])
def test_frames_of_offload_have_no_fates(trial: Path, payload_bytes: int, has_fates: bool) -> None:
    """With TCP offload, the frames of the two ends differ."""
    plan = (trial / "trial.yaml").read_text(encoding="utf-8")
    (trial / "trial.yaml").write_text(plan.replace("protocols:\n- udp", "protocols:\n- tcp"), encoding="utf-8")
    path = trial / journal.JOURNAL_FILE
    path.write_text(path.read_text(encoding="utf-8").replace('"udp"', '"tcp"'), encoding="utf-8")
    folder = (trial / "repeats" / "udp-01").rename(trial / "repeats" / "tcp-01")
    sent_packets = [recorded.segment(number, payload_bytes) for number in range(10)]
    (folder / "sender.pcap").write_bytes(file_bytes(timed(sent_packets)))
    (folder / "receiver.pcap").write_bytes(file_bytes(timed(sent_packets[1:])))
    lost_flags = [message.content.get("lost") for message in messages_of(messages(export(trial)), "/sender/packets")]
    assert lost_flags == ([True] + [False] * 9 if has_fates else [None] * 10)


@pytest.mark.parametrize(("ip_id", "receiver_address"), [(0, recorded.RECEIVER), (1, "10.42.0.9")])
def test_packets_that_cannot_be_matched_have_no_fates(trial: Path, ip_id: int, receiver_address: str) -> None:
    """The packets are equal except for their times, or the receiver has another address."""
    folder = trial / "repeats" / "udp-01"
    sent_frames = timed([recorded.packet(number * ip_id) for number in range(10)])
    received_frames = [
        replace(message, data=message.data[:16] + IPv4Address(receiver_address).packed + message.data[20:])
        for message in sent_frames[1:]
    ]
    (folder / "sender.pcap").write_bytes(file_bytes(sent_frames))
    (folder / "receiver.pcap").write_bytes(file_bytes(received_frames))
    read_messages = messages(export(trial))
    assert (
        len(messages_of(read_messages, "/sender/packets")),
        len(messages_of(read_messages, "/receiver/packets")),
    ) == (10, 9)
    assert not any("lost" in message.content or "copy" in message.content for message in read_messages)


def test_replies_without_a_time_stamp_are_omitted_and_reported(trial: Path) -> None:
    path = trial / "repeats" / "udp-01" / "ping.txt"
    text = path.read_text(encoding="utf-8")
    path.write_text("\n".join(line.partition("] ")[2] or line for line in text.split("\n")), encoding="utf-8")
    read_messages = messages(export(trial))
    assert not messages_of(read_messages, "/sender/rtt")
    (warning,) = (
        message.content
        for message in messages_of(read_messages, "/trial/log")
        if message.content["file"].endswith("ping.txt")
    )
    assert warning["message"] == "replies without a time stamp are omitted: 3"


def test_a_trial_without_an_ended_repeat_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trial = recorded.make(tmp_path)
    path = trial / journal.JOURNAL_FILE
    path.write_text(path.read_text(encoding="utf-8").splitlines(keepends=True)[0], encoding="utf-8")
    assert main(["export", str(trial), "--format", "mcap", "-o", str(tmp_path / "out.mcap")]) == 4
    assert f"fieldkit resume {trial}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [trial]


def test_a_track_replaces_the_planned_places(trial: Path) -> None:
    before = messages_of(messages(export(trial)), "/tf")
    folder = next(path for path in (trial / "repeats").iterdir() if path.name == "udp-01")
    start_ns = min(message.time_ns for message in before)
    track_points = [
        TrackPoint(start_ns - SECOND_NS, Role.SENDER, (1.0, 2.0, 0.2)),
        TrackPoint(start_ns + 10**6, Role.SENDER, (1.5, 2.0, 0.2), (2.0, 0.0, 0.0)),
        TrackPoint(start_ns + 2 * 10**6, Role.SENDER, None),
    ]
    (folder / "track.csv").write_text(track.text(track_points), encoding="ascii")
    read_messages = messages(export(trial, "tracked.mcap"))
    positions = [message.content["transforms"][0]["translation"] for message in messages_of(read_messages, "/tf")]
    assert positions == [{"x": 1.0, "y": 2.0, "z": 0.2}, {"x": 1.5, "y": 2.0, "z": 0.2}]
    assert all(
        message.content["transforms"][0]["child_frame_id"] == "turtlebot-1"
        for message in messages_of(read_messages, "/tf")
    )
    times_ns = [message.time_ns for message in messages_of(read_messages, "/tf")]
    assert times_ns == sorted(times_ns)
    assert times_ns[0] >= start_ns, "an earlier position is reported at the start of the attempt"


def test_added_positions_replace_the_track_of_the_testbed(trial: Path) -> None:
    start_ns = min(message.time_ns for message in messages_of(messages(export(trial)), "/tf"))
    folder = trial / "repeats" / "udp-01"
    (folder / "track.csv").write_text(
        track.text([TrackPoint(start_ns, role, (1.0, 2.0, 0.2)) for role in (Role.SENDER, Role.RECEIVER)])
    )
    times_s = [start_ns / SECOND_NS + second for second in (-20, -10, 0.001, 3600)]
    lines = "".join(f"{time_s:.6f},48.1,{11 + number},\n" for number, time_s in enumerate(times_s))
    (trial.parent / "walk.csv").write_text(f"t_s,lat,lon,note\n{lines}")
    assert main(["positions", str(trial), f"receiver={trial.parent / 'walk.csv'}", "sender=1m,2m"]) == 0
    read_messages = messages(export(trial, "messages.mcap"))
    for message in read_messages:
        jsonschema.validate(message.content, message.schema)
    transforms = [message.content["transforms"][0] for message in messages_of(read_messages, "/tf")]
    assert {(transform["parent_frame_id"], transform["child_frame_id"]) for transform in transforms} == {
        ("metres", "turtlebot-1")
    }
    fixes = messages_of(read_messages, "/receiver/location")
    assert all("altitude" not in message.content for message in fixes)
    assert {message.content["longitude"] for message in fixes} == {12, 13}, (
        "the position at the start of the attempt is used, and positions of other days are not"
    )
    assert fixes[0].time_ns == start_ns


def test_link_samples_have_a_channel_per_robot(trial: Path) -> None:
    folder = trial / "repeats" / "udp-01"
    station_sample = StationSample("turtlebot-2", -51.25, 65_000_000, None, 7, 5, 1, 0)
    samples = [LinkSample(BEGIN_NS, (station_sample,), noise_dbm=-95.0, active_ns=2 * SECOND_NS, busy_ns=SECOND_NS)]
    (folder / link_samples.FILE).write_text(link_samples.text({Role.SENDER: samples}), encoding="ascii")
    (sample,) = messages_of(messages(export(trial)), "/sender/link")
    jsonschema.validate(sample.content, sample.schema)
    assert (sample.time_ns, sample.clock) == (BEGIN_NS, "sender turtlebot-1")
    assert (sample.content["noise_dbm"], sample.content["active_s"], sample.content["busy_s"]) == (-95.0, 2.0, 1.0)
    assert sample.content["stations"] == [
        {
            "station": "turtlebot-2",
            "signal_dbm": -51.25,
            "tx_rate_bit_s": 65_000_000,
            "tx_packets": 7,
            "rx_packets": 5,
            "tx_retries": 1,
            "tx_failures": 0,
        }
    ]

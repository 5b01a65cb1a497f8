"""A recording equals its run, however and whenever the run ended."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scapy.utils import RawPcapReader

from fieldkit.core.errors import ConfigurationError, EvidenceError
from sim_backends.cosim.comparison import compare_runs
from sim_backends.cosim.federates import FederateError
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import Situation, SyncPolicy
from sim_backends.cosim.policies.window_policies import (
    EventDriven,
    Scheduled,
    TimeStepped,
    VelocityAware,
    VelocityAwareRaw,
)
from sim_backends.cosim.recording import packet_tables
from sim_backends.cosim.recording.manifest import RunEnding, read_manifest, write_manifest
from sim_backends.cosim.recording.recorder import RecordingError, RunRecorder
from sim_backends.cosim.recording.replay import read_recording
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario
from tests.helpers.nightly import mark_nightly
from tests.helpers.passing_robots import MS, SETTINGS, passing_robots
from tests.helpers.paths import ROOT

END_NS = 4_000 * MS
EXIT_S = 300.0
"""Longest time until a child process has exited, on a busy machine."""


def record(folder: Path, policy: SyncPolicy | None = None, part_every_s: float = 0.01, end_ns: int = END_NS) -> Run:
    with RunRecorder(folder, SETTINGS, part_every_s=part_every_s) as recorder:
        return passing_robots(recorder, policy).advance(end_ns)


@pytest.mark.parametrize(
    "policy", [TimeStepped(0.0011), Scheduled(0.05), EventDriven(), ErrorBounded(0.1)], ids=lambda policy: policy.name
)
def test_a_recording_reproduces_every_number(tmp_path: Path, policy: SyncPolicy) -> None:
    reference = passing_robots(policy=EventDriven()).advance(END_NS)
    live_run = record(tmp_path / "run", policy)
    recording = read_recording(tmp_path / "run")
    assert recording.run == live_run
    assert repr(compare_runs(reference, recording.run)) == repr(compare_runs(reference, live_run)), (
        "also if values are nan"
    )
    assert list(recording.run.fates) == list(live_run.fates), "in the same order, which affects the rounding of means"
    assert recording.manifest.ending is RunEnding.COMPLETE
    assert recording.manifest.about == SETTINGS
    # States are recorded at 10 Hz, each at the first end of a window after its due time. Robot a drives at 1 m/s, in
    # steps of 1 ms.
    states_of_a = [(at_ns, state) for at_ns, agent, state in recording.states if agent == "a"]
    assert [at_ns // (100 * MS) for at_ns, _ in states_of_a] == list(range(len(states_of_a)))
    assert len(states_of_a) >= END_NS // (100 * MS)
    assert all(state.position_m[0] == pytest.approx(at_ns // MS / 1000) for at_ns, state in states_of_a)


@pytest.mark.parametrize(
    ("policy", "pair"),
    [
        (ErrorBounded(0.1), "a and b"),
        (VelocityAware(), "a and b"),
        (VelocityAwareRaw(), "b to a"),
        (EventDriven(), ""),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_windows_have_the_pair_that_determined_them(tmp_path: Path, policy: SyncPolicy, pair: str) -> None:
    """With the rule as printed, the window is shortest if the slower robot publishes."""
    record(tmp_path / "run", policy, 1.0, 100 * MS)
    assert set(read_recording(tmp_path / "run").decided_by) == {pair}


def test_the_tables_can_be_read_without_fieldkit(tmp_path: Path) -> None:
    live_run = record(tmp_path / "run")
    packets = pq.read_table(tmp_path / "run" / "packets").to_pandas()
    arrived_packets = packets[packets.flow == "ab"].dropna(subset=["arrived_ns"])
    assert set(arrived_packets.arrived_ns - arrived_packets.enters_ns) == {1_234_567}
    assert (
        (packets.reason == "out of range").sum() == sum(bool(fate.reason) for fate in live_run.fates.values()) > 100
    )
    packets_in_flight = packets[packets.arrived_ns.isna() & (packets.reason == "")]
    assert list(packets_in_flight.sent_ns) == [1081 * 3_700_001], "sent less than its delay before the end"
    windows = pq.read_table(tmp_path / "run" / "windows")
    assert windows.column("end_ns").to_pylist() == live_run.windows_ns
    assert windows.schema.field("wait_s").metadata[b"unit"] == b"s"


@contextmanager
def recording_process(folder: Path, *limit_bytes: int) -> Iterator[subprocess.Popen[str]]:
    """Let another process record an endless run, which prints a line of progress every hundred windows."""
    command = [sys.executable, "-m", "tests.helpers.passing_robots", str(folder), *map(str, limit_bytes)]
    with subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def check_equals_run(run: Run) -> None:
    """Check that a recorded run equals the same run without a recorder."""
    expected = passing_robots().advance(run.windows_ns[-1])
    assert run.windows_ns == expected.windows_ns
    assert all(fate == expected.fates[identity] for identity, fate in run.fates.items())
    decided_identities = {identity for identity, fate in expected.fates.items() if fate.is_decided}
    assert decided_identities <= run.fates.keys(), "all decided packets are recorded"


@pytest.mark.parametrize("line_count", [1, 6, 30])
def test_a_run_that_is_killed_keeps_the_parts_written_before(tmp_path: Path, line_count: int) -> None:
    with recording_process(tmp_path / "run") as process:
        assert process.stdout is not None
        for _ in range(line_count):
            process.stdout.readline()
        assert read_manifest(tmp_path / "run").ending is RunEnding.UNDER_WAY
        part_count = len(list((tmp_path / "run" / "windows").glob("*.parquet")))
        process.send_signal(signal.SIGKILL)
        process.wait(EXIT_S)
    recording = read_recording(tmp_path / "run")
    assert (recording.manifest.ending, recording.run.digest) == (RunEnding.KILLED, "")
    assert len(list((tmp_path / "run" / "windows").glob("*.parquet"))) >= part_count
    if part_count:
        check_equals_run(recording.run)
        check_captures(tmp_path / "run", recording.run)
    assert part_count or line_count < 30


def check_captures(folder: Path, run: Run) -> None:
    """Check that captures end with a complete packet, and have at least the packets of the tables."""
    for name in "ab":
        path = folder / "captures" / f"{name}.pcap"
        frames = [data for data, _ in RawPcapReader(str(path))]
        assert path.stat().st_size == 24 + sum(16 + len(data) for data in frames)
        assert len(frames) >= sum(fate.packet.source == name for fate in run.fates.values()) > 0


def test_a_run_that_is_interrupted_is_recorded_completely(tmp_path: Path) -> None:
    with recording_process(tmp_path / "run") as process:
        assert process.stdout is not None
        for _ in range(5):
            process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=EXIT_S)
    assert "KeyboardInterrupt" in stderr
    recording = read_recording(tmp_path / "run")
    assert recording.manifest.ending is RunEnding.INTERRUPTED
    assert len(recording.run.windows_ns) >= 500
    check_equals_run(recording.run)
    assert recording.run.digest == passing_robots().advance(recording.run.windows_ns[-1]).digest


def test_a_full_disk_ends_the_run_and_keeps_the_parts_written_before(tmp_path: Path) -> None:
    """A limit of the file size simulates a full disk."""
    with recording_process(tmp_path / "run", 20_000) as process:
        _, stderr = process.communicate(timeout=EXIT_S)
    assert "RecordingError" in stderr
    assert f"{tmp_path / 'run'}: the recording cannot be written: File too large" in stderr
    recording = read_recording(tmp_path / "run")
    assert recording.manifest.ending is RunEnding.FAILED
    assert "File too large" in recording.manifest.why


@pytest.mark.emulated
@pytest.mark.parametrize("size", mark_nightly(["1300k", "3m"]))
def test_a_full_disk_is_reported_and_the_packets_are_kept(tmp_path: Path, size: str, untouched: object) -> None:
    """Captures fill the disk; the tables, which are written after them, use the reserved space."""
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "full", disk], check=True)
    try:
        command = [sys.executable, "-m", "fieldkit", "cosim", "run", "baylands", "--out", str(disk / "run")]
        changes = [f"traffic.{number}.rate=1000Hz" for number in (0, 1)]
        options = [option for change in changes for option in ("--set", change)]
        result = subprocess.run(
            [*command, *options], cwd=ROOT, capture_output=True, text=True, check=False, timeout=300
        )
        assert result.returncode == 2, result.stdout
        assert "the recording cannot be written: No space left on device" in " ".join(result.stderr.split())
        assert "Traceback" not in result.stderr
        recording = read_recording(disk / "run")
        assert recording.run.fates
        assert recording.manifest.ending is RunEnding.FAILED
        assert "No space left on device" in recording.manifest.why
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_disk_without_space_is_refused_before_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_disk_full(descriptor: int, offset: int, length: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", raise_disk_full)
    with pytest.raises(RecordingError, match="No space left on device") as error_info:
        record(tmp_path / "run")
    assert error_info.value.remedy == "free some space"


def test_the_recording_states_the_error_of_a_failed_policy(tmp_path: Path) -> None:
    class FailingPolicy(EventDriven):
        def next_window(self, situation: Situation) -> int | None:
            return super().next_window(situation) if situation.now_ns < 100 * MS else 1 // 0

    with (
        pytest.raises(FederateError, match="policy event_driven failed") as error_info,
        RunRecorder(tmp_path / "run", SETTINGS) as recorder,
    ):
        passing_robots(recorder, FailingPolicy()).advance(MS * 200)
    recording = read_recording(tmp_path / "run")
    assert (recording.manifest.ending, recording.manifest.why) == (
        RunEnding.FAILED,
        f"FederateError: {error_info.value}",
    )
    expected = passing_robots(policy=EventDriven()).advance(recording.run.windows_ns[-1])
    assert recording.run.digest == expected.digest


def test_a_scenario_that_is_refused_leaves_no_files(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigurationError, match="no sync policy"),
        RunRecorder(tmp_path / "run", SETTINGS) as recorder,
    ):
        build(load_scenario("convoy"), policy="none", recorder=recorder)
    assert not list(tmp_path.iterdir())


def test_a_recording_is_not_overwritten(recorded_folder: Path) -> None:
    with pytest.raises(ConfigurationError, match="already a recording"):
        record(recorded_folder)


def damage(folder: Path, column: str, *, forge: bool) -> None:
    """Change the first value in a column of packets; with `forge`, also the checksum of its part."""
    paths = sorted((folder / "packets").glob("*.parquet"))
    path, table = next(
        (path, table)
        for path in paths
        if (table := pq.read_table(path, partitioning=None)).column(column).null_count < len(table)
    )
    values = table.column(column).to_pylist()
    row, value = next((index, value) for index, value in enumerate(values) if value is not None)
    values[row] = value + 1 if isinstance(value, int) else [value[0] + 1, *value[1:]]
    index_of_column = table.schema.get_field_index(column)
    field = table.schema.field(column)
    pq.write_table(table.set_column(index_of_column, field, pa.array(values, field.type)), path)
    if forge:
        manifest = read_manifest(folder)
        parts = {**manifest.parts, str(path.relative_to(folder)): packet_tables.file_checksum(path)}
        write_manifest(folder, replace(manifest, parts=parts))


@pytest.mark.parametrize("column", ["arrived_ns", "known_source_m", "late_ns"])
def test_a_recording_that_was_changed_is_refused(tmp_path: Path, recorded_folder: Path, column: str) -> None:
    shutil.copytree(recorded_folder, tmp_path / "run")
    damage(tmp_path / "run", column, forge=False)
    with pytest.raises(EvidenceError, match="changed after the run"):
        read_recording(tmp_path / "run")


@pytest.mark.parametrize("column", ["arrived_ns", "sent_ns", "size_bytes", "packet_id", "number"])
def test_the_digest_alone_detects_a_changed_event(tmp_path: Path, recorded_folder: Path, column: str) -> None:
    shutil.copytree(recorded_folder, tmp_path / "run")
    damage(tmp_path / "run", column, forge=True)
    with pytest.raises(EvidenceError, match="its events have digest"):
        read_recording(tmp_path / "run")


@settings(max_examples=25)
@given(
    table=st.sampled_from(packet_tables.TABLES),
    part_number=st.integers(0),
    offset=st.integers(0),
    change=st.sampled_from(["cut", "gone", "flip"]),
)
def test_a_recording_that_was_truncated_or_damaged_anywhere_is_refused(
    recorded_folder: Path, table: str, part_number: int, offset: int, change: str
) -> None:
    parts = sorted((recorded_folder / table).glob("*.parquet"))
    path = parts[part_number % len(parts)]
    content = path.read_bytes()
    offset %= len(content)
    try:
        if change == "gone":
            path.unlink()
        elif change == "cut":
            path.write_bytes(content[:offset])
        else:
            path.write_bytes(content[:offset] + bytes([content[offset] ^ 1]) + content[offset + 1 :])
        with pytest.raises(EvidenceError, match=r"truncated|changed|missing"):
            read_recording(recorded_folder)
    finally:
        path.write_bytes(content)


@pytest.fixture(scope="module")
def recorded_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "run"
    with RunRecorder(folder, SETTINGS, part_every_s=0.02) as recorder:
        passing_robots(recorder).advance(1_000 * MS)
    return folder


def test_a_folder_without_a_recording_is_reported_without_a_traceback(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="there is no recording"):
        read_recording(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(EvidenceError, match="not the record of a run"):
        read_recording(tmp_path)
    (tmp_path / "run.json").write_text("[" * 100_000, encoding="utf-8")
    with pytest.raises(EvidenceError, match="not the record of a run"):
        read_recording(tmp_path)


@pytest.mark.parametrize("key", ["digest", "parts"])
def test_a_complete_run_without_digest_or_parts_is_refused(tmp_path: Path, recorded_folder: Path, key: str) -> None:
    shutil.copytree(recorded_folder, tmp_path / "changed")
    manifest = tmp_path / "changed" / "run.json"
    content = json.loads(manifest.read_bytes())
    manifest.write_text(json.dumps(content | {key: type(content[key])()}), encoding="utf-8")
    with pytest.raises(EvidenceError, match="the record has no digest or no parts") as error_info:
        read_recording(tmp_path / "changed")
    assert error_info.value.remedy


@pytest.mark.parametrize(
    ("old", "new"),
    [('"seed": 1', '"seed": 2'), ('"policy": "', '"policy": "not_'), ('"ending": "whole"', '"ending": "failed"')],
)
def test_a_manifest_that_was_changed_afterwards_is_refused(
    tmp_path: Path, recorded_folder: Path, old: str, new: str
) -> None:
    shutil.copytree(recorded_folder, tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(EvidenceError, match="the record was changed after the run"):
        read_recording(tmp_path / "run")
    path.write_text(json.dumps(json.loads(text)), encoding="utf-8")
    assert read_recording(tmp_path / "run").manifest.about == SETTINGS, "the formatting does not matter"


def test_a_scenario_that_was_changed_afterwards_is_refused(tmp_path: Path, recorded_folder: Path) -> None:
    shutil.copytree(recorded_folder, tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    path.write_text(path.read_text().replace("robots: two", "robots: three"))
    with pytest.raises(EvidenceError, match="its hash differs"):
        read_recording(tmp_path / "run")

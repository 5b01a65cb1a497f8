"""The output of `fieldkit cosim replay` for a run that was killed before the first part of its recording."""

import argparse
from pathlib import Path

import pytest

from fieldkit.config import schema
from sim_backends.cosim.commands import replay
from sim_backends.cosim.recording.manifest import RunManifest, RunSettings, write_manifest
from sim_backends.cosim.recording.packet_tables import TABLES
from sim_backends.cosim.scenario.loading import load_scenario


def test_a_recording_without_windows_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for table in TABLES:
        (tmp_path / table).mkdir()
    about = RunSettings(schema.dump(load_scenario("field_30ft")), "event_driven", {}, 1)
    write_manifest(tmp_path, RunManifest(about, about.scenario_hash))
    assert replay.run(argparse.Namespace(recording=tmp_path, format="table", mcap=None)) == 0
    output = capsys.readouterr()
    assert output.out.endswith("no window was recorded\n")
    note = " ".join(output.err.split())
    assert note == "note: the run did not complete (killed): the recording lacks about the last 2 s of wall time"

"""MCAP files of recordings, read by mcap's own reader and validated against their schemas."""

import json
import math
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from mcap.reader import make_reader

from fieldkit.export.schemas import TRANSFORMS
from sim_backends.cosim.policies.window_policies import TimeStepped
from sim_backends.cosim.recording.mcap import write_mcap
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.cosim.recording.replay import Recording, read_recording
from sim_backends.cosim.run_record import Run
from sim_backends.world.motion import State
from tests.helpers.passing_robots import ABOUT, MS, passing_robots

Messages = list[tuple[str, int, Any]]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("mcap") / "run"
    with RunRecorder(folder, ABOUT) as recorder:
        passing_robots(recorder, TimeStepped(0.005)).advance(1_001 * MS)
    return read_recording(folder)


@pytest.fixture(scope="module")
def messages(recording: Recording) -> Messages:
    """Return topic, time and content of each message, in the order of the file, after validation of its schema."""
    file = BytesIO()
    write_mcap(file, recording)
    reader = make_reader(BytesIO(file.getvalue()))
    records = []
    validators: dict[int, Draft202012Validator] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        assert schema is not None
        content = json.loads(message.data)
        validators.setdefault(schema.id, Draft202012Validator(json.loads(schema.data))).validate(content)
        sec, nsec = content["timestamp"]["sec"], content["timestamp"]["nsec"]
        assert sec * 10**9 + nsec == message.log_time
        records.append((channel.topic, message.log_time, content))
    assert [at_ns for _, at_ns, _ in records] == sorted(at_ns for _, at_ns, _ in records)
    return records


def test_packets_and_their_fates_are_those_of_the_run(recording: Recording, messages: Messages) -> None:
    contents = {
        (content["flow"], content["number"]): content
        for topic, _, content in messages
        if topic == f"/packets/{content.get('flow')}"
    }
    assert contents.keys() == recording.run.fates.keys()
    for identity, fate in recording.run.fates.items():
        content = contents[identity]
        assert content.get("arrived") == (None if not fate.is_decided else not fate.reason)
        assert content.get("reason", "") == fate.reason
        if fate.counted_ns is not None and fate.arrived_ns is not None:
            assert content["delay_s"] == (fate.counted_ns - fate.packet.sent_ns) / 1e9
            # The policy adds all of the delay except that of the link, in steps of 5 ms.
            assert content["delay_s"] - content["added_s"] == pytest.approx(0.001234567)
    assert {"arrived" in content for content in contents.values()} == {True, False}
    assert {content["size_bytes"] for content in contents.values()} == {100, 333}


def test_states_are_those_of_the_robots(recording: Recording, messages: Messages) -> None:
    for topic, at_ns, content in messages:
        if topic == "/states/a":
            assert content["velocity_m_s"] == pytest.approx({"x": 1, "y": 0, "z": 0})
            assert content["position_m"] == pytest.approx({"x": at_ns // MS / 1000, "y": 0, "z": 0})
    transforms = [content["transforms"][0] for topic, _, content in messages if topic == "/tf"]
    assert len(transforms) == len(recording.states) == 2 * 11
    frames = {(transform["parent_frame_id"], transform["child_frame_id"]) for transform in transforms}
    assert frames == {("world", "a"), ("world", "b")}


def test_transforms_have_the_heading_of_the_robot(recording: Recording) -> None:
    turned_state = State((1.0, 2.0, 3.0), heading_rad=math.pi / 2)
    file = BytesIO()
    write_mcap(file, replace(recording, run=Run(), states=[(5, "a", turned_state)]))
    (transform,) = (
        json.loads(message.data)["transforms"][0]
        for _, channel, message in make_reader(BytesIO(file.getvalue())).iter_messages()
        if channel.topic == "/tf"
    )
    # A quarter turn about the up axis, from east to north.
    assert transform["rotation"] == pytest.approx({"x": 0, "y": 0, "z": math.sqrt(0.5), "w": math.sqrt(0.5)})


def test_transforms_have_the_schema_that_foxglove_displays(messages: Messages) -> None:
    """The schema of the exports of trials is known to work in Foxglove."""
    for topic, _, content in messages:
        if topic == "/tf":
            Draft202012Validator(TRANSFORMS).validate(content)


def test_the_file_has_metadata_and_is_reproducible(recording: Recording) -> None:
    first, second = BytesIO(), BytesIO()
    write_mcap(first, recording)
    write_mcap(second, recording)
    assert first.getvalue() == second.getvalue()
    (metadata,) = make_reader(BytesIO(first.getvalue())).iter_metadata()
    assert metadata.metadata["digest"] == recording.run.digest
    assert metadata.metadata["policy"] == "sliding_window"
    assert json.loads(metadata.metadata["parameters"]) == ABOUT.parameters


def test_the_file_can_be_read_from_the_middle(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        write_mcap(file, recording)
    with path.open("rb") as file:
        late_times_ns = [message.log_time for _, _, message in make_reader(file).iter_messages(starting_at=900 * MS)]
    assert late_times_ns
    assert min(late_times_ns) >= 900 * MS

"""The step video: valid keys, pipelines, preflight checks, and a trial over RTP and a topic during an outage."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from fieldkit.agent.messaging import rtp_stream
from fieldkit.agent.messaging.rtp_stream import Video
from fieldkit.cli import main
from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.remote import agent
from fieldkit.ros.steps import video
from fieldkit.ros.steps.topics import TopicsStep
from fieldkit.ros.steps.video import VideoStep
from fieldkit.ros.streams import topic_samples
from fieldkit.ros.video import gstreamer
from fieldkit.steps.scene import CommandResult, Scene
from fieldkit.trial.procedure import Procedure
from tests.helpers import texts
from tests.helpers.casts import CAST

SCENE = Scene(Protocol.UDP, CAST, ".fieldkit/t/a")


def step(keys: str = "") -> VideoStep:
    return schema.validate(schema.parse(f"{{from: receiver, to: sender, {keys}}}", source="x.yaml"), VideoStep)


def topics(keys: str) -> TopicsStep:
    return schema.validate(schema.parse(f"{{from: sender, to: receiver, {keys}}}", source="x.yaml"), TopicsStep)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("to: receiver", "receiver cannot send to itself"),
        ("size: 640x", "width x height in pixels, such as 640x480"),
        ("size: 641x480", "each a multiple of 16, not 641x480"),
        ("size: 64x64", "128 to 2032 pixels wide"),
        ("rate: 1Hz, duration: 500ms", "ends before its second frame"),
        ("noise: 60 %", "less than or equal to 0.5"),
        ("reads: {rate: 0Hz}", "greater than 0"),
    ],
)
def test_invalid_keys_are_refused_with_line(keys: str, message: str) -> None:
    keys = keys if keys.startswith("to:") else f"to: sender, {keys}"
    with pytest.raises(ConfigurationError, match=message) as failed:
        schema.validate(schema.parse(f"{{from: receiver, {keys}}}", source="x.yaml"), VideoStep)
    assert failed.value.where.startswith("x.yaml:1")


def test_an_image_has_no_size_in_bytes() -> None:
    with pytest.raises(ConfigurationError, match="the size of an image is width x height; leave bytes out"):
        topics("image: 320x240, bytes: 2kB")


def test_arguments_of_receiver_and_sender() -> None:
    receive, send = step("rate: 29.97Hz, size: 320x240, quality: 50, noise: 20 %, buffer: 100ms").jobs(SCENE)
    address = CAST[Role.SENDER].address
    for planned, verb, role in ((receive, "receive-video", "sender"), (send, "send-video", "receiver")):
        assert (planned.role, planned.program, planned.job.name) == (role, "python3", verb)
        words = planned.job.argv[planned.job.argv.index("python3") :]
        assert words[1:3] == (agent.path_from_job(), verb)
        assert words[4] == f"{role}-video.bin"
        settings = Video(**json.loads(words[3]))
        assert (settings.width, settings.height, settings.noise_rows, settings.reads_hz) == (320, 240, 48, 60.0)
        pipeline = " ".join(settings.pipeline)
        assert pipeline == (
            f"gst-launch-1.0 udpsrc address={address} port=5004 caps=application/x-rtp,media=video,clock-rate=90000,"
            "encoding-name=JPEG,payload=26 ! rtpjitterbuffer latency=100 ! rtpjpegdepay ! jpegdec ! "
            "fdsink fd={fd} sync=true"
            if verb == "receive-video"
            else "gst-launch-1.0 fdsrc fd={fd} blocksize=115200 ! rawvideoparse format=i420 width=320 height=240 "
            "framerate=2997/100 ! jpegenc quality=50 ! rtpjpegpay mtu=1400 ! "
            f"udpsink host={address} port=5004 sync=false async=false"
        )
    assert receive.job.ready == "log:up,"
    assert send.job.limit_s < receive.job.limit_s
    assert "rtpjitterbuffer" not in " ".join(gstreamer.receiver(address, 5004, 0.0))


def test_constants_of_laptop_and_agent_are_equal() -> None:
    assert (rtp_stream.NAME, rtp_stream.FD) == (video._STREAM, gstreamer._FD)


def test_missing_gstreamer_fails_with_remedy() -> None:
    at_sender, at_receiver = step().needs(SCENE)
    assert (at_sender.role, at_receiver.role) == (Role.RECEIVER, Role.SENDER)
    assert {"jpegenc", "rtpjpegpay"} < set(at_sender.argv)
    assert {"rtpjpegdepay", "jpegdec"} < set(at_receiver.argv)
    remedy = "on the robot: sudo apt-get install gstreamer1.0-tools gstreamer1.0-plugins-good"
    missing = CommandResult("sh: 1: gst-inspect-1.0: not found\njpegenc\n", 0)
    assert at_sender.judge(missing) == (Verdict.FAIL, "gst-inspect-1.0 is not installed", remedy)
    assert at_sender.judge(CommandResult("jpegenc\n", 0)) == (Verdict.FAIL, "missing elements: jpegenc", remedy)
    assert at_sender.judge(CommandResult("", 0)) == (Verdict.OK, "all elements are installed", "")


def test_columns_of_seen_frames_belong_to_one_step_without_a_name() -> None:
    text = texts.procedure(
        "twice",
        """\
- video: {from: receiver, to: sender}
- topics: {from: receiver, to: sender, image: 320x240, reads: {rate: 60Hz}NAME}
""",
        protocols="udp",
    )
    with pytest.raises(ConfigurationError, match="a display of frames is defined twice"):
        schema.validate(schema.parse(text.replace("NAME", ""), source="x.yaml"), Procedure)
    schema.validate(schema.parse(text.replace("NAME", ", name: images"), source="x.yaml"), Procedure)


PROCEDURE = texts.procedure(
    "outage",
    """\
- fault:
    robot: receiver
    kind: out-of-range
    for: 4s
    after: 8s
    during:
      - capture:
          during:
            - together:
                during:
                  - topics: {from: sender, to: receiver, over: dds, rate: 20Hz, bytes: 48B, duration: 10s,
                             qos: {profile: sensor_data}, reads: {rate: 50Hz, limit: 500ms}}
                  - video: {from: receiver, to: sender, size: 160x96, duration: 10s, reads: {rate: 60Hz}}
                  - topics: {name: images, from: receiver, to: sender, over: dds, rate: 15Hz, image: 128x64,
                             duration: 10s, domain: 43, qos: {profile: sensor_data}, reads: {rate: 60Hz}}
""",
    protocols="udp",
)
STREAMS = (
    ("used", "topic", "sender", "receiver", 1 / 20, 1 / 50),
    ("seen", "video", "receiver", "sender", 1 / 30, 1 / 60),
    ("images.seen", "topic", "receiver", "sender", 1 / 15, 1 / 60),
)
"""Prefix of the columns, name of the logs, sender, receiver, interval of frames, interval of reads."""


@pytest.mark.emulated
@pytest.mark.quiet
def test_ages_grow_by_the_length_of_an_outage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robots share a clock, so each age is also the time of a read minus the time in the frame."""
    (tmp_path / "procedures").mkdir()
    (tmp_path / "procedures" / "outage.yaml").write_text(PROCEDURE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["trial", "outage", "5m", "--backend", "emulated", "--repeats", "1", "--yes"]) == 0
    (folder,) = (tmp_path / "trials").iterdir()
    (row,) = csv.DictReader((folder / "trial.csv").open(encoding="utf-8"))
    assert row["status"] == "valid"
    attempt = folder / "repeats" / "udp-01"
    words = (attempt / "fault-out-of-range-times.txt").read_text(encoding="ascii").split()
    outage_ns = int(words[1]), int(words[3])
    for prefix, stream, sender, receiver, interval_s, read_s in STREAMS:
        name = prefix.rpartition(".")[0]
        sent, received = (
            topic_samples.read_log(attempt / f"{f'{name}.' if name else ''}{role}-{stream}.bin")
            for role in (sender, receiver)
        )
        arrived = received.samples
        delays_ns = arrived.at_ns - arrived.sent_ns
        begin_ns = int(sent.samples.sent_ns[0]) + int(delays_ns.min())
        end_ns = int(sent.samples.sent_ns[-1]) + int(delays_ns.min()) + round(1e9 * interval_s)
        outage_s = (min(outage_ns[1], end_ns) - max(outage_ns[0], begin_ns)) / 1e9
        assert outage_s > 0.5, "the stream must be sent during the outage, which begins 8 s after the first job"
        values = {key: float(row[f"{prefix}_{key}"]) for key in ("age_max_s", "age_mean_s", "age_error_s", "never")}
        assert values["age_max_s"] > outage_s - read_s
        assert float(row[f"{prefix}_gap_s"]) > outage_s - interval_s - read_s
        assert values["never"] > 0.8 * outage_s / 10
        reads = received.reads
        reads = reads.where((reads.sequence >= 0) & (reads.at_ns >= begin_ns) & (reads.at_ns < end_ns))
        true_s = (reads.at_ns - reads.sent_ns) / 1e9
        assert values["age_max_s"] == pytest.approx(true_s.max(), abs=values["age_error_s"])
        assert values["age_mean_s"] == pytest.approx(true_s.mean(), abs=values["age_error_s"])
        # Closed form before the outage: mean age = delay + half an interval, up to the phase of the reads.
        before = reads.at_ns < outage_ns[0]
        if before.sum() > 60:
            steady_s, delay_s = float(np.median(true_s[before])), float(np.median(delays_ns)) / 1e9
            assert steady_s == pytest.approx(delay_s + interval_s / 2, abs=read_s + 0.02)

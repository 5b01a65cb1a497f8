"""Send the video of a synthetic camera over RTP from one robot to another; measure the age of displayed frames."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Fraction, Hertz, Int
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.model import Protocol, Role
from fieldkit.core.threads import run_parallel
from fieldkit.remote import agent, jobs
from fieldkit.remote.jobs import Job
from fieldkit.ros.streams import read_checks
from fieldkit.ros.streams.read_options import ImageSize, Reads, dimensions
from fieldkit.ros.video import gstreamer, video_checks
from fieldkit.steps import agent_commands
from fieldkit.steps.along import AlongStep
from fieldkit.steps.capabilities import HasNeeds, Listens, Prepares, SendsTraffic, Summarizes, UsesSpace
from fieldkit.steps.scene import BY_EXIT, BY_FIELDKIT, Announce, Flow, ListeningPort, Need, Planned, Scene
from fieldkit.steps.view import View, capture_around

if TYPE_CHECKING:
    from fieldkit.ros.streams.topic_checks import TopicPlan
    from fieldkit.ros.video.rtp_packets import RtpPackets

LONGEST_S: Final = 3600.0
_STREAM: Final = "video"
"""Name of the stream in its logs (`fieldkit.agent.messaging.rtp_stream.NAME`)."""
_KEPT_BYTES: Final = 128
"""Captured bytes of each packet, enough for the headers of Ethernet or radio, IPv6, UDP and RTP."""
_BUFFER_KIB: Final = 32_768
"""Kernel buffer of a capture: the packets of a frame leave in one burst."""
_PATIENCE_S: Final = 20.0
"""Time for the start of the pipelines. At its first start, GStreamer searches for its plugins."""
_OVERHEAD_S: Final = 10.0
"""Additional time in the limits of the jobs, for the start of Python and the end of the pipelines."""
_GRACE_S: Final = 8
"""Time in which the stopped receiver must exit; then it is killed."""
_RECORD_BYTES: Final = 32
"""Size of the record of a frame or a read in a log."""
_PIXELS_PER_BYTE: Final = 8
"""Approximate number of pixels without noise per byte of JPEG."""


class VideoStep(AlongStep, Prepares, HasNeeds, UsesSpace, Listens, SendsTraffic, Summarizes):
    """Sends the video of a synthetic camera as JPEG over RTP, and shows it on a simulated display.

    Both robots need GStreamer: `sudo apt-get install gstreamer1.0-tools gstreamer1.0-plugins-good`. See
    [teleoperation](teleop.md). Ages are measured inside a `capture` with packets in both directions. Writes
    `ROLE-video.bin` and `ROLE-video.log`.

    Attributes:
        sender: Role of the robot with the camera.
        receiver: Role of the operator's computer.
        rate: Frames per second.
        size: Width and height in pixels, multiples of 16.
        quality: Quality of JPEG, 1 to 100.
        noise: Share of each frame that is random, which determines the bit rate.
        buffer: Delay of the receiver's jitter buffer; `0s` shows each frame as soon as it is complete.
        reads: Refreshes of the display.
        duration: Duration of sending.
        port: UDP port of the receiver.
    """

    cross_checks = (*video_checks.CROSS_CHECKS, *read_checks.cross_checks("seen", stream=_STREAM))
    kept_bytes = _KEPT_BYTES
    capture_buffer_kib = _BUFFER_KIB

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    rate: Annotated[Hertz, Field(gt=0, le=1000)] = 30.0
    size: ImageSize = "640x480"
    quality: Annotated[Int, Field(ge=1, le=100)] = 85
    noise: Annotated[Fraction, Field(le=0.5)] = 0.1
    buffer: Annotated[Duration, Field(ge=0, le=10)] = 0.0
    reads: Reads = Reads.defaults()
    duration: Annotated[Duration, Field(gt=0, le=LONGEST_S)] = 10.0
    port: Annotated[Int, Field(ge=1024, le=65535)] = 5004

    @schema.model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.sender == self.receiver:
            raise schema.validation_error(f"{self.sender} cannot send to itself; name another robot", "to")
        if self.rate * self.duration < 1:
            raise schema.validation_error(
                "it ends before its second frame; write a longer duration or a higher rate", "duration"
            )
        return self

    @override
    def with_duration(self, seconds: float) -> Self:
        return self.model_copy(update={"duration": min(seconds, LONGEST_S)})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        address = scene.robot(self.receiver).address
        receive = gstreamer.receiver(address, self.port, self.buffer)
        send = gstreamer.sender(self.size, self.rate, self.quality, address, self.port)
        yield self._endpoint(scene, self.receiver, "receive-video", receive)
        yield self._endpoint(scene, self.sender, "send-video", send)

    def _endpoint(self, scene: Scene, role: Role, verb: str, pipeline: list[str]) -> Planned:
        """Return the job of the agent that sends or receives."""
        robot, sends = scene.robot(role), role == self.sender
        width, height = dimensions(self.size)
        arguments = agent_commands.compact(
            {
                "pipeline": pipeline,
                "width": width,
                "height": height,
                "noise_rows": round(self.noise * height),
                "rate_hz": self.rate,
                "duration_s": self.duration,
                "patience_s": _PATIENCE_S,
                "reads_hz": self.reads.rate,
            }
        )
        duration_s = _PATIENCE_S + self.duration + _OVERHEAD_S
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name(verb),
            argv=agent_commands.agent_command(robot, verb, arguments, self._file(role)),
            # The time limit of the receiver must be longer than the limit of the sender.
            limit_s=duration_s if sends else 2 * duration_s,
            log=self._log(role),
            ready=None if sends else "log:up,",
            ready_s=jobs.AGENT_READY_S,
        )
        setup, program = agent_commands.setup(robot), robot.profile.tools.python
        return Planned(role, job, program=program, setup=setup, permitted_causes=BY_EXIT if sends else BY_FIELDKIT)

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Install the agent and start the receiver; return the function that sends."""
        run_parallel(lambda role: agent.install(testbed.shells[role]), (self.sender, self.receiver))
        receive, send = self.jobs(scene)
        jobs.start(testbed.shells[receive.role], receive.job)
        return partial(self._send, scene, testbed, receive, send)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _send(self, scene: Scene, testbed: Testbed, receive: Planned, send: Planned, announce: Announce) -> None:
        announce("video", self.expected_s(scene.protocol))
        with ExitStack() as silence_contexts:
            for role in (self.sender, self.receiver):
                silence_contexts.enter_context(testbed.shells[role].silence(send.job.limit_s))
            code = jobs.run(testbed.shells[send.role], send.job)
        receiver_code = jobs.stop(testbed.shells[receive.role], receive.job, grace_s=_GRACE_S)
        for planned, exit_code in ((send, code), (receive, receiver_code)):
            if exit_code != 0:
                raise scene.failure(planned, f"{planned.job.name} ended with exit code {exit_code}")

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.duration + 3.0

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        return (ListeningPort(self.receiver, self.port, self.sender),)

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the check of GStreamer's elements on both robots."""
        yield gstreamer.need(self.sender, sends=True)
        yield gstreamer.need(self.receiver, sends=False)

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ("a video", read_checks.SEEN)

    @override
    def files(self) -> tuple[str, ...]:
        return tuple(name for role in (self.receiver, self.sender) for name in (self._file(role), self._log(role)))

    def _file(self, role: Role) -> str:
        return self.prefixed_name(f"{role}-video.bin")

    def _log(self, role: Role) -> str:
        return self.prefixed_name(f"{role}-video.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        width, height = dimensions(self.size)
        bytes_per_frame = width * height * (self.noise + (1 - self.noise) / _PIXELS_PER_BYTE)
        packets = self.rate * self.duration * (1 + bytes_per_frame / gstreamer.PACKET_BYTES)
        yield Flow(self.sender, self.receiver, self.port, packets, protocol=Protocol.UDP)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        rate_hz = self.rate + (self.reads.rate if role == self.receiver else 0.0)
        return _RECORD_BYTES * rate_hz * self.duration if role in self.roles() else 0.0

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of videos, which only trials with this step have."""
        from fieldkit.ros.video import video_columns  # noqa: PLC0415 (needed only by this step)

        return video_columns.COLUMNS

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if a log is incomplete, or contradicts the other log, the attempt or the captures."""
        from fieldkit.ros.streams import topic_checks, topic_evidence  # noqa: PLC0415 (needed only by this step)

        logs, errors = topic_evidence.read_logs(view, self._files)
        yield from errors
        yield from topic_checks.check_times(logs, {role: view.attempt_window(role) for role in logs})
        if errors:
            return
        sent, received = logs[self.sender], logs[self.receiver]
        reasons = [*topic_checks.check_logs(self._plan(), sent, received), *read_checks.check_reads(received)]
        yield from reasons
        sender, receiver = (self._rtp_packets(view, role) for role in (self.sender, self.receiver))
        if not reasons and sender is not None and receiver is not None:
            yield from video_checks.check_captures(sent, received, sender, receiver)

    def _plan(self) -> "TopicPlan":
        """Return the settings with which the logs are compared."""
        from fieldkit.ros.streams import topic_checks  # noqa: PLC0415 (needed only by this step)

        width, height = dimensions(self.size)
        return topic_checks.TopicPlan(
            topic=_STREAM,
            samples=round(self.rate * self.duration),
            size_bytes=width * height * 3 // 2,  # the format I420 has 12 bits per pixel
            envelope_bytes=0,
            reliable=False,
            depth=None,
            in_order=True,
            uses_expected_ports=True,
        )

    @property
    def _files(self) -> Mapping[Role, str]:
        return {role: self._file(role) for role in (self.sender, self.receiver)}

    @override
    def measure(self, view: View) -> Measured:
        from fieldkit.ros.streams import sample_reads, topic_evidence  # noqa: PLC0415 (needed only by this step)
        from fieldkit.ros.video import video_columns  # noqa: PLC0415 (needed only by this step)

        logs, _ = topic_evidence.read_logs(view, self._files)
        roles = self.sender, self.receiver
        sent, received = (logs.get(role) for role in roles)
        rtp_sent, rtp_received = (self._rtp_packets(view, role) for role in roles)
        captures = [view.capture(role) for role in roles]
        sender, receiver = (capture.packets if capture else None for capture in captures)
        plan = sample_reads.ReadPlan("seen", self.reads.rate, self.reads.limit, 1 / self.rate)
        addresses = (view.scene.robot(role).address for role in roles)
        clocks, unknown_clocks = sample_reads.find_clocks(sender, receiver, *addresses)
        return (
            video_columns.measure_frames(sent, received)
            | video_columns.measure_packets(rtp_sent, rtp_received, received, 1 / self.rate)
            | sample_reads.measure(plan, sent, received, clocks, unknown_clocks)
        )

    def _rtp_packets(self, view: View, role: Role) -> "RtpPackets | None":
        """Return the packets of the video in a robot's capture; None without a complete capture."""
        from fieldkit.ros.video import rtp_packets  # noqa: PLC0415 (needed only by this step)

        name = capture_around(view.within, role)
        return (
            None
            if name is None or view.capture(role) is None
            else view.evidence.read(rtp_packets.read, name, self.port)
        )

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(loss := values.get("video_loss"), float):
            yield f"frame loss {100 * loss:.1f} %"
        if isinstance(age_s := values.get("seen_age_p95_s"), float):
            yield f"age of displayed frames {1e3 * age_s:.1f} ms"

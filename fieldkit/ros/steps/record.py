"""Record a ROS bag on a robot."""

from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Annotated, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Cast, Robot, Testbed
from fieldkit.config import locations, schema
from fieldkit.config.profiles import Ros, TopicName
from fieldkit.config.schema import Bool, Duration, Field
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.errors import ConfigurationError, EvidenceError, RobotError
from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.measure.evidence import recordings
from fieldkit.remote import jobs
from fieldkit.remote.command import quote, with_environment
from fieldkit.remote.jobs import Job
from fieldkit.ros.steps import ros_master
from fieldkit.steps import variants
from fieldkit.steps.base import Step, StepName
from fieldkit.steps.capabilities import (
    HasNeeds,
    HasRefusals,
    Records,
    ReservesSpace,
    Subscribes,
    Summarizes,
    UsesSpace,
)
from fieldkit.steps.scene import (
    BY_EXIT,
    BY_LIMIT,
    Announce,
    CommandResult,
    Need,
    Planned,
    RecordedFile,
    Refusal,
    Scene,
)
from fieldkit.steps.variants import Recorder, Tool
from fieldkit.steps.view import View

DEFAULT_BAG: Final = "scan"

# Time that a recorder may take in addition to its duration. rosbag took 0.6 to 0.8 s, and 3.2 s on a lossy interface.
START_AND_CLOSE_S: Final = 20.0

# A recorder needs up to a second to subscribe, and more on a small computer under load. A recording has failed if the
# duration of its bag plus `SUBSCRIBE_S` is less than half of the planned duration.
SUBSCRIBE_S: Final = 1.0
MIN_RECORDED_SHARE: Final = 0.5

ROSBAG_RESERVE_BYTES: Final = 1 << 30
"""Free space below which ROS 1's rosbag records nothing and reports it only in its log (ros_comm 1.15)."""

# Approximate size of a message without its variable arrays; see the ROS message definitions.
_MESSAGE_BYTES: Final = {
    "sensor_msgs/LaserScan": 100,
    "sensor_msgs/Imu": 340,
    "sensor_msgs/BatteryState": 100,
    "nav_msgs/Odometry": 720,
}
_OTHER_MESSAGE_BYTES: Final = 1_000
# Range and intensity of a beam, 4 bytes each.
_BEAM_BYTES: Final = 8
# Assumed for a topic that is not in the profile.
_UNKNOWN_BYTES_PER_S: Final = 100_000
# Format 2.0 of rosbag: record header and index entry per message, and chunks and message definitions per bag.
_RECORD_BYTES: Final = 60
_BAG_BYTES: Final = 16_384

SUBSCRIBED: Final = "log:Subscribed to topic"
"""Condition for the start of the duration: `ros2 bag record` has logged its first subscription. The program needs
seconds to start, which are not part of the duration."""


class RecordStep(Step, HasRefusals, HasNeeds, Subscribes, UsesSpace, ReservesSpace, Records, Summarizes):
    """Records a ROS bag with the record command of the robot's profile.

    A robot may record several bags with different names, one after the other; the `file` of a `transfer` selects one.

    Attributes:
        robot: Role that records.
        topics: The recorded topics.
        duration: Duration of the recording.
        name: Name of the bag without its extension; the names of its job and log start with it, unless it is `scan`.
        reception: Whether columns report how soon and how regularly the messages of its topics were received: [what a
            recorder received](method-delay.md#what-a-recorder-received).
    """

    cross_checks = (
        CrossCheck(
            quantity="content of a bag, and times of reception",
            columns=("*",),
            source="the bag",
            against=("the procedure: topics and duration", "duration of the recorder's job"),
            tolerance=(
                "a bag may be shorter than planned by half of the planned duration plus 1 s, because a recorder "
                "needs time to subscribe"
            ),
        ),
    )

    robot: Role
    topics: Annotated[tuple[TopicName, ...], Field(min_length=1)]
    duration: Annotated[Duration, Field(gt=0)]
    name: StepName = DEFAULT_BAG
    reception: Bool = Field(default=False, exclude_if=schema.is_empty)

    @property
    @override
    def prefix(self) -> str:
        """Prefix of its job and log; empty for the default name of the bag."""
        return "" if self.name == DEFAULT_BAG else self.name

    def bag(self, robot: Robot) -> str:
        """Return the path of the recorded file, relative to the attempt's folder.

        Raises:
            ConfigurationError: The profile of the robot has no `ros`.
        """
        return _ros(robot).command.writes.format(name=self.name)

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        robot = scene.robot(self.robot)
        ros = _ros(robot)
        argv: list[str] = []
        for word in ros.command.record:
            if word == "{topics}":
                argv += self.topics
            else:
                argv.append(word.format(duration_s=f"{self.duration:g}", name=self.name))
        has_duration = ros.command.ends == "itself"
        yield Planned(
            self.robot,
            Job(
                folder=scene.folder,
                name=self.prefixed_name("record"),
                argv=with_environment(argv, setup=ros.command.setup, environment=robot.ros_environment),
                # A recorder without an option for the duration is stopped by SIGINT at the limit of the job.
                limit_s=self.duration + START_AND_CLOSE_S if has_duration else self.duration,
                ready=None if has_duration else SUBSCRIBED,
                log=self._log,
            ),
            program=ros.command.record[0],
            setup=ros.command.setup,
            tool=Tool.RECORDER,
            permitted_causes=BY_EXIT if has_duration else BY_LIMIT,
            min_duration_s=self.duration,
        )

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        profile = scene.robot(self.robot).profile
        actual, expected = scene.tools(self.robot).recorder, variants.expected(profile).recorder
        if actual is expected:
            return
        command = _ros(scene.robot(self.robot)).command
        ros = f"ros-{command.distribution}"
        packages = {
            Recorder.ROSBAG: f"{ros}-rosbag",
            Recorder.SQLITE3: f"{ros}-ros2bag {ros}-rosbag2-storage-default-plugins",
            Recorder.MCAP: f"{ros}-ros2bag {ros}-rosbag2-storage-mcap",
        }
        install = f"sudo apt-get install {packages[expected]}, and check record and setup in its profile"
        if actual is Recorder.NONE:
            yield Refusal(self.robot, f"its record command cannot write {expected}", install)
        else:
            what = f"its record command writes {actual}, but its profile names {command.writes}"
            yield Refusal(self.robot, what, f"correct --storage in record, or writes, in the profile {profile.name}")

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        (planned,) = self.jobs(scene)
        announce("record", self.duration)
        code = jobs.run(testbed.shells[self.robot], planned.job)
        # After SIGINT the exit code of a recorder depends on its version; `check` reads the bag instead.
        if code != 0 and _ros(scene.robot(self.robot)).command.ends == "itself":
            raise RobotError(
                f"recording ended with exit code {code}",
                where=scene.robot(self.robot).name,
                remedy=f"see {planned.job.log} of this repeat; is ROS running on the robot?",
            )

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the checks of the ROS environment and of a shared ROS master."""
        robot = scene.robot(self.robot)
        ros = _ros(robot)
        command = ("sh", "-c", 'echo "$ROS_DISTRO $ROS_MASTER_URI"')
        argv = with_environment(command, setup=ros.command.setup, environment=robot.ros_environment)
        yield Need(
            self.robot, "ROS", argv, lambda answer: _judge(robot, answer), missing_program=ros.command.record[0]
        )
        yield from ros_master.needs(scene, self.robot, program=ros.command.record[0])

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return (f"a recording on {self.robot}",)

    @override
    def files(self) -> tuple[str, ...]:
        return (f"{self.name}.bag", self.name, self._log)

    @property
    def _log(self) -> str:
        return self.prefixed_name(f"{self.robot}-record.log")

    @override
    def recordings(self, cast: Cast) -> Iterator[RecordedFile]:
        robot = cast[self.robot]
        size_bytes = _BAG_BYTES + self.duration * sum(_bytes_per_s(robot, topic) for topic in self.topics)
        yield RecordedFile(self.robot, self.bag(robot), size_bytes, alias=self.name)

    @override
    def records_on(self) -> frozenset[Role]:
        return frozenset({self.robot})

    @override
    def live_topics(self, role: Role) -> tuple[str, ...]:
        return self.topics if role is self.robot else ()

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        return sum(file.size_bytes for file in self.recordings(scene.cast) if file.role is role)

    @override
    def reserve_bytes(self, scene: Scene, role: Role) -> int:
        program = _ros(scene.robot(self.robot)).command.record[0]
        return ROSBAG_RESERVE_BYTES if role is self.robot and PurePosixPath(program).name == "rosbag" else 0

    @override
    def with_record(self, duration_s: float) -> Self:
        return self.model_copy(update={"duration": duration_s})

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if the bag is unreadable, lacks messages of a topic, or is too short."""
        path = self.bag(view.scene.robot(self.robot))
        name = PurePosixPath(path).name
        try:
            content = view.evidence.read(recordings.read, path)
        except EvidenceError as error:
            yield f"{name}: {error.what}"
            return
        topics_without_messages = [topic for topic in self.topics if not content.messages_by_topic.get(topic)]
        if topics_without_messages:
            yield f"{name}: no message of {', '.join(topics_without_messages)}"
        if content.duration_s + SUBSCRIBE_S < MIN_RECORDED_SHARE * self.duration:
            yield f"{name}: spans only {content.duration_s:.1f} s of {self.duration:g} s"

    @override
    def output_columns(self) -> tuple[Column, ...]:
        if not self.reception:
            return ()
        from fieldkit.ros.bags import recorded_topics  # noqa: PLC0415 (only with `reception: true`)

        return recorded_topics.COLUMNS

    @override
    def measure(self, view: View) -> Measured:
        if not self.reception:
            return Measured()
        from fieldkit.ros.bags import recorded_topics  # noqa: PLC0415 (only with `reception: true`)

        arguments = self._log, self.bag(view.scene.robot(self.robot)), self.topics, self.duration
        return recorded_topics.measure(view.evidence.read_or_none(recorded_topics.read, "", *arguments))

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        discovery_s = values.get("bag_discovery_s")
        if isinstance(discovery_s, float):
            yield f"received after {discovery_s:.2f} s"
        elif values.get("bag_discovered") is False:
            yield "a topic without messages"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.duration + 0.5  # a recorder needs about this time to start and to close its bag


def _ros(robot: Robot) -> Ros:
    """Return the section `ros` of the profile of a robot.

    Raises:
        ConfigurationError: The profile has no such section.
    """
    if robot.profile.ros is None:
        raise ConfigurationError(
            f"{robot.name} cannot record: its profile {robot.profile.name} has no ros",
            remedy="let another robot record, or describe its ROS under ros: in the profile: "
            + locations.copy_profile_command(robot.profile.name),
        )
    return robot.profile.ros


def _bytes_per_s(robot: Robot, name: str) -> float:
    """Return the growth of a bag by a topic in bytes per second, from the topic's rate and type in the profile."""
    for topic in _ros(robot).topics:
        if topic.name == name:
            arrays = topic.payload_bytes or _BEAM_BYTES * (topic.points or 0)
            message = _MESSAGE_BYTES.get(topic.type, _OTHER_MESSAGE_BYTES) + arrays
            return topic.rate * (message + _RECORD_BYTES)
    return _UNKNOWN_BYTES_PER_S


def _judge(robot: Robot, answer: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy for the ROS environment that the setup files create."""
    ros, profile = _ros(robot), robot.profile.name
    command = ros.command
    distribution, _, master = answer.text.partition(" ")
    if not answer.ok:
        return Verdict.FAIL, answer.text, f"ls -l {quote(command.setup)}   # correct setup in profile {profile}"
    if ros.variant == "ros1" and not master:
        remedy = f"write ROS_MASTER_URI under ros.environment in profile {profile}"
        return Verdict.WARN, "ROS_MASTER_URI is not set", remedy
    if distribution and distribution != command.distribution:
        remedy = f"write distribution: {distribution} in profile {profile}"
        return Verdict.WARN, f"{distribution}; the profile has {command.distribution}", remedy
    return Verdict.OK, ", master ".join(answer.text.split()) or "no ROS environment", ""

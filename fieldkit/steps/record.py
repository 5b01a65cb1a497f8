"""Record a ROS bag on a robot."""

from collections.abc import Iterator
from typing import Annotated, Final

from fieldkit.backends.protocols import Robot, Testbed
from fieldkit.config.schema import Duration, Field
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.steps import variants
from fieldkit.steps.base import Announce, Planned, Refusal, Scene, Step
from fieldkit.steps.variants import Recorder, Tool

# rosbag took 0.6 to 0.8 s longer than its duration (facts, section 1), 3.2 s on a lossy interface.
START_AND_CLOSE_S: Final = 20.0

SUBSCRIBED: Final = "log:Subscribed to topic"
"""What `ros2 bag record` says when it begins to record; it takes seconds to start, which must not count."""


class Record(Step):
    """`rosbag record` for a fixed time, by the command that the robot's profile names.

    Attributes:
        robot: Who records.
        topics: What.
        duration: How long, in seconds.
        name: Name of the bag without its ending.
    """

    robot: Role
    topics: Annotated[tuple[Annotated[str, Field(pattern=r"^(/[A-Za-z][A-Za-z0-9_]*)+$")], ...], Field(min_length=1)]
    duration: Annotated[Duration, Field(gt=0)]
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,30}$")] = "scan"

    def bag(self, robot: Robot) -> str:
        """Return the name of the file, below the attempt's folder, that the robot's recorder leaves behind."""
        return robot.profile.ros.command.writes.format(name=self.name)

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        robot = scene.robot(self.robot)
        ros = robot.profile.ros
        argv: list[str] = []
        for word in ros.command.record:
            if word == "{topics}":
                argv += self.topics
            else:
                argv.append(word.format(duration_s=f"{self.duration:g}", name=self.name))
        ends_itself = ros.command.ends == "itself"
        yield Planned(
            self.robot,
            Job(
                folder=scene.folder,
                name="record",
                argv=with_environment(argv, setup=ros.command.setup, environment=ros.environment),
                # A recorder without a duration is ended by SIGINT, which is how the robot enforces a job's limit.
                limit_s=self.duration + START_AND_CLOSE_S if ends_itself else self.duration,
                ready=None if ends_itself else SUBSCRIBED,
                log=f"{self.robot}-record.log",
            ),
            program=ros.command.record[0],
            setup=ros.command.setup,
            tool=Tool.RECORDER,
        )

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        profile = scene.robot(self.robot).profile
        found, wanted = scene.tools(self.robot).recorder, variants.expected(profile).recorder
        if found is wanted:
            return
        ros = f"ros-{profile.ros.command.distribution}"
        packages = {
            Recorder.ROSBAG: f"{ros}-rosbag",
            Recorder.SQLITE3: f"{ros}-ros2bag {ros}-rosbag2-storage-default-plugins",
            Recorder.MCAP: f"{ros}-ros2bag {ros}-rosbag2-storage-mcap",
        }
        install = f"sudo apt-get install {packages[wanted]}, and look at record and setup in its profile"
        if found is Recorder.NONE:
            yield Refusal(self.robot, f"its record command cannot write {wanted}", install)
        else:
            what = f"its record command writes {found}, its profile says {profile.ros.command.writes}"
            yield Refusal(self.robot, what, f"--storage in record, or writes, in the profile {profile.name}")

    def run(self, scene: Scene, lab: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        (planned,) = self.commands(scene)
        announce("record", self.duration)
        code = jobs.run(lab.shells[self.robot], planned.job)
        # What a recorder ended by SIGINT returns differs from version to version; the bag tells whether it recorded.
        if code != 0 and scene.robot(self.robot).profile.ros.command.ends == "itself":
            raise RobotError(
                f"recording ended with exit code {code}",
                where=scene.robot(self.robot).name,
                remedy=f"see {planned.job.log} of this repeat; is ROS running on the robot?",
            )

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.robot})

    def leaves(self) -> tuple[str, ...]:
        """See `Step.leaves`."""
        return (f"a recording on {self.robot}", f"the file {self.name}.bag")

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """See `Step.expected_s`."""
        return self.duration + 0.5

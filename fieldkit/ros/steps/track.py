"""Record the positions of robots while other steps run: odometry, satellite receivers, or a tracking system."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Final, Literal

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.profiles import TopicName
from fieldkit.config.schema import Duration, Field, Number, Strict
from fieldkit.core import geometry
from fieldkit.core.columns import Column, Measured
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.positions import position_checks, position_sources, samples
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.robot_clock import Offset
from fieldkit.ros.steps.record import SUBSCRIBE_S, RecordStep
from fieldkit.steps import position_recording
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import (
    ChecksPlacement,
    HasNeeds,
    HasRefusals,
    ReservesSpace,
    Subscribes,
    UsesSpace,
    WritesOnLaptop,
)
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import BY_FIELDKIT, Announce, Need, Planned, Refusal, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.view import View

_EXTRA_PERIODS: Final = 1.5
"""Waiting time before the first step inside and recording time after the last one, in periods of the topic."""
ODOMETRY: Final = "nav_msgs/Odometry"

# Shell script that runs the command after $1 and $2, and prints "recording" $2 s after the bag $1 has been opened,
# because rosbag prints its messages only when its output buffer is full. The waiting subshell is not a child of the
# command, because the command may wait for all its children.
_RECORD_SCRIPT: Final = (
    '( (until [ -e "$1" ] || [ -e "$1.active" ]; do sleep 0.1; done; sleep "$2"; echo recording >&2) & ); '
    'shift 2; exec "$@"'
)


class FixedPosition(Strict):
    """A fixed position of a robot: degrees and metres on the earth, or metres in the frame of a tracker.

    Attributes:
        lat: Degrees north, if the other robots publish `NavSatFix`.
        lon: Degrees east.
        alt: Metres above the ellipsoid.
        frame: A tracker's frame, the `frame_id` of its messages.
        x: Metres along the first axis of that frame.
        y: Metres along its second axis.
        z: Metres along its third axis.
    """

    lat: Annotated[Number | schema.Int, Field(ge=-90, le=90)] | None = None
    lon: Annotated[Number | schema.Int, Field(ge=-180, le=180)] | None = None
    alt: Number | schema.Int | None = None
    frame: str | None = None
    x: Number | schema.Int | None = None
    y: Number | schema.Int | None = None
    z: Number | schema.Int = 0.0

    @schema.model_validator(mode="after")
    def _has_one_position(self) -> "FixedPosition":
        on_earth, in_frame = (self.lat, self.lon), (self.frame, self.x, self.y)
        if None in (on_earth if self.frame is None else in_frame):
            raise schema.validation_error("a position needs lat and lon, or frame, x and y")
        if self.frame is not None and (*on_earth, self.alt) != (None, None, None):
            raise schema.validation_error("a position has lat and lon, or frame, x and y, not both")
        return self

    @property
    def position_source(self) -> PositionSource:
        """This position as the source of a robot's positions."""
        if self.frame is not None:
            return PositionSource(
                place=(float(self.x or 0), float(self.y or 0), float(self.z)), frame=f"frame {self.frame}"
            )
        up_m = None if self.alt is None else float(self.alt)
        return PositionSource(place=(float(self.lat or 0), float(self.lon or 0), up_m), frame=samples.WGS84)


class TrackedRobot(Strict):
    """Source of the position of one robot.

    Attributes:
        topic: A topic of `nav_msgs/Odometry` or `sensor_msgs/NavSatFix`, or a tracker's topic of
            `geometry_msgs/PoseStamped`, `PoseWithCovarianceStamped`, `TransformStamped` or `tf2_msgs/TFMessage`.
            Either this or `at` is required.
        facing: Direction in which the robot faces when the step begins; required for odometry. `away`: away from the
            robot at the other end of its link; `towards`: towards that robot; `left` and `right`: to the left and to
            the right of the direction `away`.
        child: Frame of the robot, for a topic of transforms: only transforms of this child frame are used. Their
            parent frame is the tracker's frame.
        times: Time of a message: `header` for its stamp, or `received` for its time of reception, if the stamps are
            from another clock.
        gap: If more than this time is between two consecutive messages, the position between them is unknown.
        at: A fixed position, instead of a topic.
    """

    topic: TopicName | None = None
    facing: Literal["away", "towards", "left", "right"] | None = None
    child: str | None = None
    times: Literal["header", "received"] = "header"
    gap: Annotated[Duration, Field(gt=0)] = position_sources.GAP_S
    at: FixedPosition | None = None

    @schema.model_validator(mode="after")
    def _has_one_source(self) -> "TrackedRobot":
        if (self.topic is None) is (self.at is None):
            raise schema.validation_error("a robot needs either topic or at")
        return self


class TrackStep(Nest, ChecksPlacement, HasRefusals, HasNeeds, Subscribes, UsesSpace, ReservesSpace, WritesOnLaptop):
    """Records the position of each robot on that robot, with its profile's record command, while inner steps run.

    The distance and speed columns of the transfers and pings inside use these positions
    ([method](method-radio.md#where-robots-were)). Robots that are not listed are assumed to stay at their placement,
    unless a step inside moves them. A repeat has at most one `track` or `mavlink` with `positions`. A `track` must
    not be inside a move, a fault or a `together`. Adds the columns `positions_from` and `positions_clock_error_s`.
    Writes `track_ROLE.bag` (ROS 2: a folder) and `positions.json`, which records the source of each position, and the
    offset of each robot's clock from the laptop's clock.

    Attributes:
        robots: Source of each robot's position, by role.
        heights: Whether heights above the ellipsoid are used; heights of satellite receivers are often wrong by 10 m.
        during: Steps that run in order while the positions are recorded.
    """

    cross_checks = position_checks.POSITION_CHECKS

    robots: Annotated[dict[Role, TrackedRobot], Field(min_length=1)]
    heights: schema.Bool = False
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield from self._recordings(scene)
        yield from self.inside(scene)

    def _recordings(self, scene: Scene) -> list[Planned]:
        """Return the jobs that record the topics until they are stopped, after the steps inside, or reach a limit."""
        limit_s = position_recording.LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene))
        return [self._recording(scene, recorder) for recorder in self._recorders(limit_s).values()]

    def _recording(self, scene: Scene, recorder: RecordStep) -> Planned:
        (planned,) = recorder.jobs(scene)
        arguments = (recorder.bag(scene.robot(planned.role)), str(self._wait_s(scene, planned.role)))
        job = replace(
            planned.job,
            name=self.prefixed_name("track"),
            argv=("sh", "-c", _RECORD_SCRIPT, "sh", *arguments, *planned.job.argv),
            limit_s=recorder.duration,
            ready="log:recording",
        )
        return replace(planned, job=job, permitted_causes=BY_FIELDKIT, min_duration_s=0.0)

    def _recorders(self, duration_s: float = 1.0) -> Mapping[Role, RecordStep]:
        """Return a `record` step for each robot with a topic.

        Only the job of the step and the size of its bag depend on `duration_s`.
        """
        return {
            role: RecordStep.model_validate(
                {
                    "robot": role,
                    "topics": [tracked.topic],
                    "duration": f"{duration_s:.9g}s",
                    "name": f"track_{role}"[:31],  # the maximum length of a name
                }
            )
            for role, tracked in self.robots.items()
            if tracked.topic is not None
        }

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Run the steps inside while the topics are recorded.

        The exit codes of the recorders are ignored, because `check` reads the bags.
        """
        announce("record positions", None)
        position_recording.run_while_recording(
            self,
            scene,
            testbed,
            announce,
            self._recordings(scene),
            make_sources=partial(self._position_sources, scene),
            extra_s=lambda recording: self._wait_s(scene, recording.role),
        )

    def _wait_s(self, scene: Scene, role: Role) -> int:
        """Return `_EXTRA_PERIODS` of the robot's topic, rounded up to seconds; 2 s if the profile gives no rate."""
        ros = scene.robot(role).profile.ros
        rates_hz = (
            [topic.rate for topic in ros.topics if topic.name == self.robots[role].topic and topic.rate]
            if ros
            else []
        )
        return math.ceil(_EXTRA_PERIODS / min(rates_hz, default=1.0))

    def _position_sources(self, scene: Scene, began_utc_ns: int, offsets: Mapping[Role, Offset]) -> PositionSources:
        """Return the sources of the robots' positions in an attempt."""
        places_m = scene.places_m
        sources = dict(position_recording.stationary_robots(self, scene))
        for role, tracked in self.robots.items():
            if tracked.at is not None:
                sources[role] = tracked.at.position_source
            elif tracked.topic is not None:
                sources[role] = PositionSource(
                    file=self._recorders()[role].bag(scene.robot(role)),
                    topic=tracked.topic,
                    child=tracked.child or "",
                    stamps=tracked.times,
                    gap_s=tracked.gap,
                    start=places_m.get(role, (0.0, 0.0, 0.0)),
                    heading_rad=None if tracked.facing is None else geometry.heading_rad(role, tracked.facing),
                    began_utc_ns=began_utc_ns,
                )
        return PositionSources(sources, offsets, self.heights)

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """Yield the refusals of the recorders, and a reason for odometry without `facing`."""
        for role, recorder in self._recorders().items():
            yield from recorder.refusals(scene)
            ros = scene.robot(role).profile.ros
            kinds = {topic.name: topic.type for topic in ros.topics} if ros else {}
            if kinds.get(recorder.topics[0]) == ODOMETRY and self.robots[role].facing is None:
                what = "its odometry is relative to its direction at the start of the step, which is unknown"
                yield Refusal(role, what, "write facing: away, towards, left or right, in the step track")

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        for recorder in self._recorders().values():
            yield from recorder.needs(scene)

    @override
    def live_topics(self, role: Role) -> tuple[str, ...]:
        recorder = self._recorders().get(role)
        return recorder.topics if recorder else ()

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        recorder = self._recorders(self.expected_s(scene.protocol)).get(role)
        return recorder.stored_bytes(scene, role) if recorder else 0.0

    @override
    def reserve_bytes(self, scene: Scene, role: Role) -> int:
        recorder = self._recorders().get(role)
        return recorder.reserve_bytes(scene, role) if recorder else 0

    @override
    def files(self) -> tuple[str, ...]:
        return (
            position_sources.FILE,
            *(name for recorder in self._recorders().values() for name in recorder.files()),
        )

    @override
    def laptop_files(self) -> tuple[str, ...]:
        return (position_sources.FILE,)

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        if any(isinstance(step, TrackStep) for step in earlier):
            return "a repeat can have only one track: list all robots in it, and put all steps into it"
        return position_recording.placement_error("track", earlier, within)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield the reasons why the recorded positions cannot be used."""
        yield from position_recording.problems(view, list(self._recorders()))

    @override
    def output_columns(self) -> tuple[Column, ...]:
        return position_recording.COLUMNS

    @override
    def measure(self, view: View) -> Measured:
        return position_recording.measure(view)

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return 2 * SUBSCRIBE_S + 1.0 + self.inside_s(protocol)

"""Record the MAVLink telemetry of an autopilot while other steps run: position, speed, attitude, battery, losses."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Annotated, Final, Literal

import numpy as np
from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Duration, Field, Hertz, Int
from fieldkit.core import geometry
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.positions import position_checks, position_sources
from fieldkit.measure.positions.position_sources import GAP_S, PositionSource, PositionSources
from fieldkit.measure.robot_clock import Offset
from fieldkit.motion.logs import motion_sources, tlog
from fieldkit.motion.logs.tlog import GLOBAL, LOCAL, Tlog
from fieldkit.motion.profile_sections import mavlink_of
from fieldkit.motion.steps.link_need import link_need
from fieldkit.remote import agent
from fieldkit.remote.jobs import Job
from fieldkit.steps import agent_commands, position_recording
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import ChecksPlacement, HasNeeds, SendsTraffic, Summarizes, UsesSpace, WritesOnLaptop
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import BY_FIELDKIT, Announce, Flow, Need, Planned, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.view import View

MESSAGES: Final = MappingProxyType(
    {
        "SYS_STATUS": 1,
        "GPS_RAW_INT": 24,
        "ATTITUDE": 30,
        LOCAL: 32,
        GLOBAL: 33,
        "VFR_HUD": 74,
        "RADIO_STATUS": 109,
        "BATTERY_STATUS": 147,
        "ESTIMATOR_STATUS": 230,
        "HOME_POSITION": 242,
        "EXTENDED_SYS_STATE": 245,
    }
)
"""Ids of the messages whose rate a procedure may request (https://mavlink.io/en/messages/common.html)."""

_POSITIONS: Final = MappingProxyType({"local": LOCAL, "global": GLOBAL})
_DEFAULT_HZ: Final = 40.0
"""Approximate number of messages per second that an autopilot sends without a request."""
_FRAME_BYTES: Final = 40
_STAMP_BYTES: Final = 8
"""Approximate size of a frame in the log, and size of the time before it."""
_START_S: Final = 2.0
"""Approximate time for the start of the recorder."""
_READY_S: Final = 75
"""Timeout for the start of the recorder, whose own timeout is 60 s: ArduCopter sends LOCAL_POSITION_NED about 30 s
after its boot."""
_ON_GROUND_M: Final = 0.1
"""Lower heights are noise of the position estimate of a drone on the ground."""
_EXTRA_S: Final = 2
"""Recording time after the last step, enough for a message of each kind at default rates."""


def _validate_message(name: str) -> str:
    if name not in MESSAGES:
        raise schema.validation_error(f"no rate can be requested for {name!r}; possible: {', '.join(MESSAGES)}")
    return name


class MavlinkStep(Nest, ChecksPlacement, HasNeeds, UsesSpace, SendsTraffic, WritesOnLaptop, Summarizes):
    """Records the telemetry of a robot's autopilot while the steps in `during` run.

    Telemetry is position, speed, attitude, battery and losses. [MAVLink](mavlink.md#record-telemetry) also describes
    the columns. The profile of the robot needs `mavlink`. Writes `mavlink.tlog`, `mavlink.json` (counters of the
    recorder) and `ROLE-mavlink.log`; with `positions` also `positions.json` and the columns of a `track`.

    Attributes:
        robot: Role of the robot with the autopilot.
        at: Role of the robot that records over the radio; by default the computer of `robot` records.
        system: The autopilot's system id; 0 for the first one received, which must then be the only one in the log.
        rates: Requested messages per second, of `SYS_STATUS`, `GPS_RAW_INT`, `ATTITUDE`, `LOCAL_POSITION_NED`,
            `GLOBAL_POSITION_INT`, `VFR_HUD`, `RADIO_STATUS`, `BATTERY_STATUS`, `ESTIMATOR_STATUS`, `HOME_POSITION`
            and `EXTENDED_SYS_STATE`: `{ATTITUDE: 20Hz}`. Every message received is recorded.
        positions: Message that fills the columns of distances and speeds: `local` for `LOCAL_POSITION_NED`, `global`
            for `GLOBAL_POSITION_INT`. Such a step must not be inside a move, a fault or a `together`, or in a
            procedure with a `track`.
        facing: With `local`, direction of the robot when the step begins: `away` from the robot at the other end of
            its link, `towards` that robot, or to the `left` or `right` of the direction `away`.
        times: Time of a message: `header` for the autopilot's time, or `received` for the time of arrival.
        gap: If two consecutive messages are further apart than this, the position between them is unknown.
        heights: Whether heights above the sea are used, with `global`.
        during: Steps that run in order while the telemetry is recorded.
    """

    cross_checks = (*motion_sources.OF_TELEMETRY, *position_checks.POSITION_CHECKS)

    robot: Role
    at: Role | None = None
    system: Annotated[Int, Field(ge=0, le=255)] = 0
    rates: dict[Annotated[str, AfterValidator(_validate_message)], Annotated[Hertz, Field(gt=0, le=1000)]] = Field(
        default_factory=dict
    )
    positions: Literal["local", "global"] | None = None
    facing: Literal["away", "towards", "left", "right"] | None = None
    times: Literal["header", "received"] = "header"
    gap: Annotated[Duration, Field(gt=0)] = GAP_S
    heights: schema.Bool = False
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _has_direction(self) -> "MavlinkStep":
        if (self.positions == "local") is (self.facing is None):
            raise schema.validation_error(
                "facing is required with positions: local, and not allowed otherwise", "facing"
            )
        return self

    @property
    def recorder(self) -> Role:
        """Role of the robot that records."""
        return self.at or self.robot

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield self._recording(scene)
        yield from self.inside(scene)

    def _recording(self, scene: Scene) -> Planned:
        """Return the job that records until it is stopped."""
        robot = scene.robot(self.recorder)
        intervals_us = {str(MESSAGES[name]): round(1e6 / rate) for name, rate in self.rates.items()}
        arguments = {"connection": self._connection(scene), "intervals_us": intervals_us, "system": self.system}
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name("mavlink"),
            argv=agent_commands.agent_command(robot, "mavlink", agent_commands.compact(arguments), self._file),
            limit_s=position_recording.LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene)),
            log=self._log,
            stdout=self._counters_file,
            ready="log:up,",
            ready_s=_READY_S,
        )
        setup, program = agent_commands.setup(robot), robot.profile.tools.python
        return Planned(self.recorder, job, program=program, setup=setup, permitted_causes=BY_FIELDKIT)

    def _connection(self, scene: Scene) -> str:
        """Return the connection from the recorder to the autopilot.

        Raises:
            ConfigurationError: The profile of the robot has no `mavlink`.
        """
        robot = scene.robot(self.robot)
        if (mavlink := mavlink_of(robot.profile)) is None:
            raise ConfigurationError(
                f"telemetry of {robot.name} cannot be recorded: its profile {robot.profile.name} has no mavlink",
                remedy="write mavlink: {port: 14550} in the profile, or name another robot in the `mavlink` step",
            )
        if self.recorder != self.robot:
            return f"udpout:{robot.address}:{mavlink.port}"
        return mavlink.onboard_connection

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the check of the connection to the autopilot.

        A connection over the radio is not checked, because its losses are part of the measurement.
        """
        if self.recorder == self.robot:
            yield link_need(scene.robot(self.recorder), self.recorder, self._connection(scene), ("recorder",))

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        agent.install(testbed.shells[self.recorder])
        announce("record MAVLink", None)
        ((planned, code),) = position_recording.run_while_recording(
            self,
            scene,
            testbed,
            announce,
            [self._recording(scene)],
            make_sources=partial(self._position_sources, scene) if self.positions else None,
            extra_s=lambda _: _EXTRA_S,
        )
        if code != 0:
            raise scene.failure(planned, f"{planned.job.name} ended with exit code {code}")

    def _position_sources(self, scene: Scene, began_utc_ns: int, offsets: Mapping[Role, Offset]) -> PositionSources:
        """Return the sources of the robots' positions in an attempt."""
        position_source = PositionSource(
            file=self._file,
            topic=_POSITIONS[self.positions or "local"],
            stamps=self.times,
            gap_s=self.gap,
            start=scene.places_m.get(self.robot, (0.0, 0.0, 0.0)),
            heading_rad=None if self.facing is None else geometry.heading_rad(self.robot, self.facing),
            began_utc_ns=began_utc_ns,
            clock="" if self.recorder == self.robot else self.recorder,
            system=self.system,
        )
        return PositionSources(
            {**position_recording.stationary_robots(self, scene), self.robot: position_source}, offsets, self.heights
        )

    @override
    def roles(self) -> frozenset[Role]:
        return frozenset({self.robot, self.recorder}) | self.roles_inside()

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ("a telemetry log",)

    @override
    def files(self) -> tuple[str, ...]:
        return (self._file, self._counters_file, self._log, *self.laptop_files())

    @override
    def laptop_files(self) -> tuple[str, ...]:
        return (position_sources.FILE,) if self.positions else ()

    @property
    def _file(self) -> str:
        return self.prefixed_name(f"mavlink{tlog.SUFFIX}")

    @property
    def _counters_file(self) -> str:
        return self.prefixed_name("mavlink.json")

    @property
    def _log(self) -> str:
        return self.prefixed_name(f"{self.recorder}-mavlink.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        """Yield the flow of the telemetry if another robot records it over the radio."""
        mavlink = mavlink_of(scene.robot(self.robot).profile)
        if self.recorder != self.robot and mavlink is not None:
            frames = self._messages(scene)
            yield Flow(self.robot, self.recorder, mavlink.port, frames, Protocol.UDP, has_other_listener=True)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        return (_FRAME_BYTES + _STAMP_BYTES) * self._messages(scene) if role == self.recorder else 0.0

    def _messages(self, scene: Scene) -> float:
        """Return the approximate number of recorded messages."""
        return (_DEFAULT_HZ + sum(self.rates.values())) * self.expected_s(scene.protocol)

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        if self.positions is None:
            return None
        return position_recording.placement_error("mavlink with positions", earlier, within)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if the log is incomplete, lacks requested messages, or contradicts its recorder."""
        try:
            counters = view.evidence.read(tlog.read_summary, self._counters_file)
            log = self._read(view)
            file_crc32 = view.evidence.read(tlog.crc32_of, self._file)
        except EvidenceError as error:
            yield f"{self._file}: {error.what}"
            return
        if counters.dropped_frames:
            frames_text = format_count(counters.dropped_frames, "received frame")
            yield f"{self._file} lacks {frames_text}, because it reached its maximum size"
        if log.frames != counters.frames:
            yield f"{self._file} has {log.frames} frames, but its recorder wrote {counters.frames}"
        window = view.attempt_window(self.recorder)
        yield from (f"{self._file} {reason}" for reason in tlog.contradictions(log, counters, file_crc32, window))
        for name in self.rates:
            if (result := counters.refusals.get(MESSAGES[name])) is not None:
                yield f"the autopilot refused the request for {name} (MAV_RESULT {result})"
            elif name not in log.kinds:
                yield f"{self._file}: no {name}, which was requested"
        if self.positions:
            yield from position_recording.problems(view, (self.robot,))

    def places_m(self, view: View) -> Floats:
        """Return the positions in the messages LOCAL_POSITION_NED: metres east, north and up. Shape (n, 3)."""
        rows = view.evidence.read_or_none(tlog.positions, self._file, self.system, LOCAL) or []
        return np.array([row[2:5] for row in rows], dtype=float).reshape(-1, 3)

    def _read(self, view: View) -> Tlog:
        """Return the content of the log.

        Raises:
            EvidenceError: The log or the counters of its recorder cannot be read.
        """
        counters = view.evidence.read(tlog.read_summary, self._counters_file)
        intervals_us = tuple((name, round(1e6 / rate)) for name, rate in self.rates.items())
        return view.evidence.read(tlog.read, self._file, self.system, counters.ended_us, intervals_us)

    @override
    def output_columns(self) -> tuple[Column, ...]:
        return (*tlog.COLUMNS, *(position_recording.COLUMNS if self.positions else ()))

    @override
    def measure(self, view: View) -> Measured:
        try:
            measured = tlog.measure(
                self._read(view), view.evidence.read(tlog.read_summary, self._counters_file).slow_s
            )
        except EvidenceError:
            measured = tlog.measure(None)
        return measured | position_recording.measure(view) if self.positions else measured

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(loss := values.get("mavlink_loss"), float):
            yield f"MAVLink loss {100 * loss:.1f} %"
        if isinstance(height_m := values.get("mavlink_height_max_m"), float) and height_m > _ON_GROUND_M:
            yield f"up to {height_m:.1f} m high"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return _START_S + _EXTRA_S + self.inside_s(protocol)

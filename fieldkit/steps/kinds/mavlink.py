"""Record what an autopilot tells over MAVLink while other steps run: place, speed, attitude, battery, losses."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Annotated, Final, Literal

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Duration, Field, Hertz, Int
from fieldkit.core import geometry
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import tlog
from fieldkit.measure.evidence.tlog import GLOBAL, LOCAL, Tlog
from fieldkit.measure.offsets import Offset
from fieldkit.measure.positions import accounts
from fieldkit.measure.positions.accounts import GAP_S, Account, Accounts
from fieldkit.remote import agent
from fieldkit.remote.jobs import Job
from fieldkit.steps import streams
from fieldkit.steps.base import Nest, Step, StepEntry, View
from fieldkit.steps.kinds import follow
from fieldkit.steps.scene import BY_FIELDKIT, Announce, Flow, Planned, Scene

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
"""Ids of the messages whose rate a procedure may ask for (https://mavlink.io/en/messages/common.html)."""

_POSITIONS: Final = MappingProxyType({"local": LOCAL, "global": GLOBAL})
_USUAL_HZ: Final = 40.0
"""About how many messages a second an autopilot sends to whom it is not asked by."""
_FRAME_BYTES: Final = 40
_STAMP_BYTES: Final = 8
_BEGINS_S: Final = 2.0
_OUTLASTS_S: Final = 2
"""Behind the last step a message of each kind is to come, at the usual rates."""


def _is_message(name: str) -> str:
    if name not in MESSAGES:
        raise schema.complaint(f"no rate can be asked for {name!r}; there are {', '.join(MESSAGES)}")
    return name


class MavlinkStep(Nest):
    """A telemetry log of a robot's autopilot, recorded on that robot or, over the radio, on another.

    Attributes:
        robot: Whose autopilot.
        at: On whose robot it is recorded; None for the robot's own computer.
        system: The autopilot's system id; 0 for the first that is heard.
        rates: Messages a second that are asked for; others come as the autopilot sends them.
        positions: Which message fills the columns of distances and speeds; None for none.
        facing: Where the robot faces when the step begins, as who looks away from the other end of its link sees it.
        times: `header`, messages were true when the autopilot's own time says; `received`, when they came.
        gap: Longest time between two messages in which it went straight.
        heights: Whether heights over the sea count, with `global`.
        during: Steps inside.
    """

    robot: Role
    at: Role | None = None
    system: Annotated[Int, Field(ge=0, le=255)] = 0
    rates: dict[Annotated[str, AfterValidator(_is_message)], Annotated[Hertz, Field(gt=0, le=1000)]] = Field(
        default_factory=dict
    )
    positions: Literal["local", "global"] | None = None
    facing: Literal["away", "towards", "left", "right"] | None = None
    times: Literal["header", "received"] = "header"
    gap: Annotated[Duration, Field(gt=0)] = GAP_S
    heights: schema.Bool = False
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _faces_somewhere(self) -> "MavlinkStep":
        if (self.positions == "local") is (self.facing is None):
            raise schema.complaint("with positions: local, and only then, say where it faces", "facing")
        return self

    @property
    def recorder(self) -> Role:
        """On whose robot it is recorded."""
        return self.at or self.robot

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        yield self._recording(scene)
        yield from self.inside(scene)

    def _recording(self, scene: Scene) -> Planned:
        """Return what records until it is stopped."""
        robot = scene.robot(self.recorder)
        intervals_us = {str(MESSAGES[name]): round(1e6 / rate) for name, rate in self.rates.items()}
        told = {"connection": self._connection(scene), "intervals_us": intervals_us, "system": self.system}
        job = Job(
            folder=scene.folder,
            name=self.own_name("mavlink"),
            argv=streams.agent_command(robot, "mavlink", streams.compact(told), self._file),
            limit_s=follow.LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene)),
            log=self._log,
            stdout=self._told,
            ready="log:up,",
        )
        setup, program = streams.setup(robot), robot.profile.tools.python
        return Planned(self.recorder, job, program=program, setup=setup, ends=BY_FIELDKIT)

    def _connection(self, scene: Scene) -> str:
        """Return how the recorder reaches the autopilot.

        Raises:
            ConfigurationError: Its robot has none.
        """
        robot = scene.robot(self.robot)
        if (mavlink := robot.profile.mavlink) is None:
            raise ConfigurationError(
                f"{robot.name} is to tell of its flight, and its profile {robot.profile.name} has no mavlink",
                remedy="write mavlink: {port: 14550} in the profile, or name another robot in the step mavlink",
            )
        if self.recorder != self.robot:
            return f"udpout:{robot.address}:{mavlink.port}"
        return mavlink.own

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        agent.install(testbed.shells[self.recorder])
        announce("record MAVLink", None)
        ((planned, code),) = follow.follow(
            self,
            scene,
            testbed,
            announce,
            [self._recording(scene)],
            tell=partial(self._accounts, scene) if self.positions else None,
            outlast=lambda _: _OUTLASTS_S,
        )
        if code != 0:
            raise scene.failure(planned, f"{planned.job.name} ended with exit code {code}")

    def _accounts(self, scene: Scene, began_utc_ns: int, offsets: Mapping[Role, Offset]) -> Accounts:
        """Return who tells where robots were in an attempt."""
        account = Account(
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
        return Accounts({**follow.standing(self, scene), self.robot: account}, offsets, self.heights)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.robot, self.recorder}) | self.roles_inside()

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("a telemetry log", *(("a track",) if self.positions else ()))

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return (self._file, self._told, self._log, *((accounts.FILE,) if self.positions else ()))

    @property
    def _file(self) -> str:
        return self.own_name(f"mavlink{tlog.SUFFIX}")

    @property
    def _told(self) -> str:
        return self.own_name("mavlink.json")

    @property
    def _log(self) -> str:
        return self.own_name(f"{self.recorder}-mavlink.log")

    def flows(self, scene: Scene) -> Iterator[Flow]:
        """See `Step.flows`: over the radio, where another robot records it."""
        mavlink = scene.robot(self.robot).profile.mavlink
        if self.recorder != self.robot and mavlink is not None:
            frames = self._messages(scene)
            yield Flow(self.robot, self.recorder, mavlink.port, frames, Protocol.UDP, served=True)

    def bytes_left(self, scene: Scene, role: Role) -> float:
        """See `Step.bytes_left`."""
        return (_FRAME_BYTES + _STAMP_BYTES) * self._messages(scene) if role == self.recorder else 0.0

    def _messages(self, scene: Scene) -> float:
        """Return about how many messages are recorded."""
        return (_USUAL_HZ + sum(self.rates.values())) * self.expected_s(scene.protocol)

    def misplaced(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:  # noqa: ARG002 (others may tell of other robots)
        """See `Step.misplaced`."""
        return None if self.positions is None else follow.misplaced("mavlink with positions", within)

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: the log is whole, of one autopilot, and has what was asked for."""
        try:
            told = view.evidence.read(tlog.told, self._told)
            log = self._read(view)
        except EvidenceError as error:
            yield f"{self._file}: {error.what}"
            return
        if told.left_out:
            yield f"{self._file}: {told.left_out} frames more came than it has room for"
        if log.frames != told.frames:
            yield f"{self._file} has {log.frames} frames, its recorder wrote {told.frames}"
        for name in self.rates:
            if (result := told.refused.get(MESSAGES[name])) is not None:
                yield f"the autopilot does not send {name} as asked (MAV_RESULT {result})"
            elif name not in log.kinds:
                yield f"{self._file}: no {name}, which was asked for"
        if self.positions:
            yield from follow.problems(view, (self.robot,))

    def _read(self, view: View) -> Tlog:
        """Return what the log says.

        Raises:
            EvidenceError: It, or what its recorder says of it, cannot be read.
        """
        told = view.evidence.read(tlog.told, self._told)
        return view.evidence.read(tlog.read, self._file, self.system, told.ended_us)

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`."""
        return (*tlog.COLUMNS, *(follow.COLUMNS if self.positions else ()))

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        try:
            found = tlog.measure(self._read(view))
        except EvidenceError:
            found = tlog.measure(None)
        return found | follow.measure(view) if self.positions else found

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        if isinstance(loss := values.get("mavlink_loss"), float):
            yield f"MAVLink loss {100 * loss:.1f} %"
        if isinstance(height_m := values.get("mavlink_height_max_m"), float):
            yield f"up to {height_m:.1f} m high"

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return _BEGINS_S + _OUTLASTS_S + self.inside_s(protocol)

"""Let a robot move away from its place, or about it, while other steps run."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Final, Self

from fieldkit.backends.protocols import Cast, Robot, Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Field, Length, Speed, Strict
from fieldkit.core import geometry, model
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import drive_log
from fieldkit.steps import driving, streams
from fieldkit.steps.base import Nest, Step, StepEntry, View
from fieldkit.steps.lease import run_inside
from fieldkit.steps.scene import Announce, Need, Planned, Refusal, Scene

_Way = Annotated[Length, Field(gt=0)] | None

_SHORT_OF_FENCE_M: Final = 0.5
"""So far before its fence a way ends that is cut short: who steers along it may overshoot."""


class PathLeg(Strict):
    """A straight piece of a way; along and across together are a slant.

    Attributes:
        away: So far away from the robot at the other end of the link.
        towards: So far towards it.
        left: So far to the left, as who looks away from it sees it.
        right: So far to the right.
    """

    away: _Way = None
    towards: _Way = None
    left: _Way = None
    right: _Way = None

    @schema.model_validator(mode="after")
    def _one_direction(self) -> "PathLeg":
        for one, other in (("away", "towards"), ("left", "right")):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise schema.complaint(f"a piece of a way goes {one} or {other}; make two pieces", other)
        if not any((self.away, self.towards, self.left, self.right)):
            raise schema.complaint("say how far, and whether away, towards, left or right")
        return self

    @classmethod
    def of(cls, leg: model.Leg) -> "PathLeg | None":
        """Return a leg as a procedure has it, to the centimetre and no longer; None where nothing is left of it."""
        named = (("away", "towards", leg.away_m), ("left", "right", leg.left_m))
        lengths = {
            (one if metres > 0 else other): math.floor(100 * abs(metres)) / 100 for one, other, metres in named
        }
        if not any(lengths.values()):
            return None
        return cls.defaults().model_copy(update={name: metres or None for name, metres in lengths.items()})

    @property
    def leg(self) -> model.Leg:
        """The leg of the way as the testbed is asked for it."""
        return model.Leg((self.away or 0.0) - (self.towards or 0.0), (self.left or 0.0) - (self.right or 0.0))


class MoveStep(Nest):
    """A robot moves while other steps run, for as long as they do; then it comes back to its place.

    One that drives by itself (`Robot.drives`) does so by the agent on it; others the testbed moves.

    Attributes:
        robot: Which.
        path: Its way from its place, piece by piece. At the end of it the robot stands.
        speed: How fast; None for as fast as the robot may.
        within_limits: Whether a robot that may not go as fast or as far goes as it may; otherwise it is refused.
        driven: Whether columns tell how it drove by itself; a plan says so where it does.
        during: The steps inside.
    """

    leads = True

    robot: Role
    path: Annotated[tuple[PathLeg, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)] | None = None
    within_limits: Bool = Field(default=False, exclude_if=schema.is_empty)
    driven: Bool = Field(default=False, exclude_if=schema.is_empty)
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    def fitted(self, cast: Cast, way_s: float | None = None) -> Self:  # noqa: ARG002 (its own is the innermost)
        """See `Step.fitted`: with a speed, and within the robot's limits where that is asked for."""
        robot = cast[self.robot]
        fastest_m_s, fence_m = robot.profile.limits.max_speed_m_s, robot.profile.limits.fence_m
        speed_m_s = fastest_m_s if self.speed is None else self.speed
        legs = tuple(one.leg for one in self.path)
        path = self.path
        if self.within_limits:
            speed_m_s = min(speed_m_s, fastest_m_s)
            if fence_m is not None and geometry.farthest_m(legs) > fence_m:
                short_m = min(_SHORT_OF_FENCE_M, fence_m / 2)
                path = tuple(filter(None, map(PathLeg.of, geometry.within(legs, fence_m - short_m)))) or path
        update = {"path": path, "speed": speed_m_s, "within_limits": False, "driven": self.driven or robot.drives}
        own = self.model_copy(update=update)
        return super(MoveStep, own).fitted(cast, own.way_s(robot))

    def shortened(self, cast: Cast) -> Iterator[str]:
        """See `Step.shortened`."""
        if self.within_limits:
            asked = self.model_copy(update={"within_limits": False}).fitted(cast).motion
            may = self.fitted(cast).motion
            if may != asked:
                yield (
                    f"{cast[self.robot].name} moves {geometry.in_words(may)}; {geometry.in_words(asked)} is beyond "
                    "its limits"
                )
        yield from super().shortened(cast)

    @property
    def motion(self) -> model.Move:
        """The move that the testbed is asked for.

        Raises:
            ValueError: The step has no speed: it is not fitted to its robot.
        """
        if self.speed is None:
            raise ValueError("a step without a speed is not fitted to its robot")
        return model.Move(self.robot, tuple(one.leg for one in self.path), self.speed)

    @property
    def lasts_s(self) -> float:
        """How long its way takes at its speed, to the millisecond; what a robot needs to turn comes to it."""
        motion = self.motion
        return round(geometry.length_m(motion) / motion.speed_m_s, 3)

    def way_s(self, robot: Robot) -> float:
        """Return how long its way takes: of a robot that drives by itself with all turns, else `lasts_s`."""
        return driving.way_s(robot, self.motion) if robot.drives else self.lasts_s

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`; a robot that is moved takes none."""
        if scene.robot(self.robot).drives:
            yield self._driving(scene)
        yield from self.inside(scene)

    def _driving(self, scene: Scene) -> Planned:
        """Return the job that drives the robot."""
        inside_s = sum(one.job.limit_s for one in self.inside(scene))
        return driving.planned(scene, self.motion, inside_s, self._form)

    @property
    def _form(self) -> str:
        return self.own_name("{}")

    @property
    def _log(self) -> str:
        return self.own_name(drive_log.FILE)

    def beside(self, scene: Scene) -> Iterator[str]:
        """See `Step.beside`."""
        robot = scene.robot(self.robot)
        by_itself = ""
        if robot.drives and robot.profile.drive is not None:
            drive = robot.profile.drive
            by_itself = (
                f", and back, by itself: velocities on {drive.topic}, odometry of {drive.odometry}; it stops where "
                f"the laptop is silent for {drive.lease:g} s, and {robot.profile.limits.fence_m:g} m from its place"
            )
        lasts = f"for up to {round(self.way_s(robot), 1):g} s"
        yield f"{robot.name} moves {geometry.in_words(self.motion)}, {lasts}{by_itself}"
        yield from super().beside(scene)

    def cut_short(self, scene: Scene) -> Iterator[str]:
        """See `Step.cut_short`."""
        if scene.robot(self.robot).drives:
            yield f"{scene.robot(self.robot).name} stands where it is"
        yield from super().cut_short(scene)

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        robot = scene.robot(self.robot)
        fastest_m_s = robot.profile.limits.max_speed_m_s
        speed_m_s = self.motion.speed_m_s
        if speed_m_s > fastest_m_s:
            yield Refusal(
                self.robot,
                f"its top speed is {fastest_m_s:g} m/s, and it is to move at {speed_m_s:g} m/s",
                "a lower speed in the procedure, or within_limits: true; limits.max_speed_m_s in its profile says it",
            )
        if robot.drives:
            yield from driving.refusals(scene, self.motion)
        yield from super().refusals(scene)

    def needs(self, scene: Scene) -> Iterator[Need]:
        """See `Step.needs`: a robot that drives by itself needs its middleware's Python package."""
        robot = scene.robot(self.robot)
        if robot.drives:
            yield streams.need(self.robot, robot, driving.over(robot))

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        robot = scene.robot(self.robot)
        announce(f"move {robot.name}", None)
        if robot.drives:
            with driving.driven(scene, testbed, self._driving(scene), self.motion, self._form) as held:
                run_inside(self, held, scene, testbed, announce)
                announce(f"drive {robot.name} back", self.way_s(robot))
            return
        with testbed.moving(self.motion):
            for entry in self.during:
                entry.step.run(scene, testbed, announce)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.robot}) | self.roles_inside()

    def moves(self) -> frozenset[Role]:
        """See `Step.moves`."""
        return frozenset({self.robot})

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("a move",)  # each robot may write down how it drove

    def files(self) -> tuple[str, ...]:
        """See `Step.files`: what the driver of a robot writes, where that drives by itself."""
        return driving.files(self._form)

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`; a trial whose robots are moved has no columns for it."""
        return drive_log.COLUMNS if self.driven else ()

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: a robot that drove by itself has written down how."""
        if self.driven and view.scene.robot(self.robot).drives:
            try:
                view.evidence.read(drive_log.read, self._log)
            except EvidenceError as error:
                yield f"{self._log}: {error.what}"

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        return drive_log.measure(view.evidence.known(drive_log.read, self._log)) if self.driven else Measured()

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        if isinstance(driven_m := values.get("drive_out_m"), float):
            yield f"drove {driven_m:.1f} m"

    def misplaced(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:  # noqa: ARG002 (see the base)
        """See `Step.misplaced`."""
        if any(nest.disturbs for nest in within):
            return "a fault has no move inside: put the fault into the move"
        if any(nest.parallel for nest in within):
            return "a move does not stand in together: put together into the move"
        return None

    def asks(self) -> bool:
        """See `Step.asks`."""
        return True

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return self.inside_s(protocol) + (self.lasts_s if self.driven else 0.0)

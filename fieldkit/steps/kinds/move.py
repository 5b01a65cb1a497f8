"""Let a robot move away from its place, or about it, while other steps run."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Annotated

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Field, Length, Speed, Strict
from fieldkit.core import geometry, model
from fieldkit.core.model import Protocol, Role
from fieldkit.steps import driving, streams
from fieldkit.steps.base import Nest, Step, StepEntry
from fieldkit.steps.scene import Announce, Need, Planned, Refusal, Scene

_Way = Annotated[Length, Field(gt=0)] | None


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
        speed: How fast.
        during: The steps inside.
    """

    robot: Role
    path: Annotated[tuple[PathLeg, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)]
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @property
    def motion(self) -> model.Move:
        """The move that the testbed is asked for."""
        return model.Move(self.robot, tuple(one.leg for one in self.path), self.speed)

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

    def beside(self, scene: Scene) -> Iterator[str]:
        """See `Step.beside`."""
        lasts_s = geometry.length_m(self.motion) / self.speed
        robot = scene.robot(self.robot)
        by_itself = ""
        if robot.drives and robot.profile.drive is not None:
            drive = robot.profile.drive
            by_itself = (
                f", and back, by itself: velocities on {drive.topic}, odometry of {drive.odometry}; it stops where "
                f"the laptop is silent for {drive.lease:g} s, and {robot.profile.limits.fence_m:g} m from its place"
            )
        yield f"{robot.name} moves {geometry.in_words(self.motion)}, for up to {lasts_s:g} s{by_itself}"
        yield from super().beside(scene)

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        robot = scene.robot(self.robot)
        fastest_m_s = robot.profile.limits.max_speed_m_s
        if self.speed > fastest_m_s:
            yield Refusal(
                self.robot,
                f"its top speed is {fastest_m_s:g} m/s, and it is to move at {self.speed:g} m/s",
                "a lower speed in the procedure, or another robot; limits.max_speed_m_s in its profile says it",
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
        announce(f"move {scene.robot(self.robot).name}", None)
        moving: AbstractContextManager[None]
        if scene.robot(self.robot).drives:
            moving = driving.driven(scene, testbed, self._driving(scene), self.motion, self._form)
        else:
            moving = testbed.moving(self.motion)
        with moving:
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
        return (f"a move of {self.robot}",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`: what the driver of a robot writes, where that drives by itself."""
        return driving.files(self._form)

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
        return self.inside_s(protocol)

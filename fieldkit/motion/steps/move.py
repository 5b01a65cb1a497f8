"""Move a robot along a path while other steps run, and bring it back to its place."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Cast, Robot, Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Field, Speed
from fieldkit.core import geometry, model
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.positions import recorded_positions
from fieldkit.motion import driven_paths
from fieldkit.motion.logs import drive_checks, drive_log, motion_log, motion_sources
from fieldkit.motion.profile_sections import can_drive, drive_of
from fieldkit.motion.steps import driving
from fieldkit.motion.steps.lease import run_inside
from fieldkit.ros.streams import stream_options
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import (
    AsksOperator,
    ChecksPlacement,
    DescribesActions,
    HasNeeds,
    HasRefusals,
    Moves,
    ReducesSettings,
    Summarizes,
    UsesSpace,
)
from fieldkit.steps.legs import PathLeg
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Announce, Need, Planned, Refusal, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.view import View

_LOG_BYTES_PER_S: Final = 2200.0
"""Growth of the log: ten lines a second (`agent/driving/drive.py`), each of about 220 bytes."""
_FENCE_MARGIN_M: Final = 0.5
"""Distance between the fence and the end of a shortened path, because the robot may overshoot."""


class MoveStep(
    Nest,
    DescribesActions,
    Moves,
    AsksOperator,
    ReducesSettings,
    ChecksPlacement,
    HasRefusals,
    HasNeeds,
    UsesSpace,
    Summarizes,
):
    """Moves a robot while the steps in `during` run; afterwards the robot is at its place again.

    Therefore, all repeats start from the same place. At the end of its path the robot stops and waits. Robots of a
    lab move on the ground of their world, and return instantly; in the field the operator is asked to start the
    motion and to bring the robot back. Ground robots that [fieldkit drives](motion.md) move and return automatically,
    with `--allow-motion`, and write `drive.jsonl`. `--dry-run` describes the path. A move may be inside a move of
    another robot; one of the two needs a `name`, because each may write such a file. A `fault` may be inside a move;
    a move must not be inside a fault.

    Attributes:
        robot: Role that moves.
        path: Its path, a list of straight segments; each begins where the previous one ends.
        speed: Speed, `0.2m/s`; by default `limits.max_speed_m_s` of its profile. A trial with a higher speed is
            refused.
        within_limits: Whether a robot whose `limits.max_speed_m_s` or `limits.fence_m` are exceeded moves as far and
            as fast as they allow, and stops half a metre before the fence; `trial.yaml` records the actual motion.
            Otherwise the trial is refused.
        driven: Whether trials have columns of its [automatic drive](motion.md#evidence-of-a-drive). A robot that
            fieldkit drives always has them.
        during: Steps that run in order while the robot moves.
    """

    has_path = True
    cross_checks = motion_sources.OF_DRIVE

    robot: Role
    path: Annotated[tuple[PathLeg, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)] | None = None
    within_limits: Bool = Field(default=False, exclude_if=schema.is_empty)
    driven: Bool = Field(default=False, exclude_if=schema.is_empty)
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @override
    def resolved(self, cast: Cast, path_s: float | None = None) -> Self:
        """Return the step with a speed. With `within_limits`, path and speed are reduced to the robot's limits."""
        robot = cast[self.robot]
        fastest_m_s, fence_m = robot.profile.limits.max_speed_m_s, robot.profile.limits.fence_m
        speed_m_s = fastest_m_s if self.speed is None else self.speed
        legs = tuple(segment.leg for segment in self.path)
        path = self.path
        if self.within_limits:
            speed_m_s = min(speed_m_s, fastest_m_s)
            if fence_m is not None and driven_paths.farthest_m(legs) > fence_m:
                margin_m = min(_FENCE_MARGIN_M, fence_m / 2)
                # A path of which nothing remains is kept unchanged.
                path = tuple(filter(None, map(PathLeg.of, driven_paths.clip_path(legs, fence_m - margin_m)))) or path
        update = {"path": path, "speed": speed_m_s, "within_limits": False, "driven": self.driven or can_drive(robot)}
        step = self.model_copy(update=update)
        return super(MoveStep, step).resolved(cast, step.path_s(robot))

    @override
    def adjustments(self, cast: Cast) -> Iterator[str]:
        if self.within_limits:
            requested_move = self.model_copy(update={"within_limits": False}).resolved(cast).motion
            permitted_move = self.resolved(cast).motion
            if permitted_move != requested_move:
                permitted_text, requested_text = (
                    geometry.describe_move(permitted_move),
                    geometry.describe_move(requested_move),
                )
                yield f"{cast[self.robot].name} moves {permitted_text}; {requested_text} is beyond its limits"

    @property
    def motion(self) -> model.Move:
        """The move as the data type that testbeds accept.

        Raises:
            ValueError: The step has no speed, because it is not resolved.
        """
        if self.speed is None:
            raise ValueError("the step has no speed: call resolved() first")
        return model.Move(self.robot, tuple(segment.leg for segment in self.path), self.speed)

    @property
    def straight_s(self) -> float:
        """Duration of the path at its speed, without turns, in seconds, rounded to milliseconds."""
        motion = self.motion
        return round(driven_paths.length_m(motion) / motion.speed_m_s, 3)

    def path_s(self, robot: Robot) -> float:
        """Return the duration of the path in seconds, including turns if the robot drives automatically."""
        return driving.path_duration_s(robot, self.motion) if can_drive(robot) else self.straight_s

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        """Yield the job that drives the robot, unless the testbed moves it, and the jobs of the steps inside."""
        if can_drive(scene.robot(self.robot)):
            yield self._driving(scene)
        yield from self.inside(scene)

    def _driving(self, scene: Scene) -> Planned:
        """Return the job that drives the robot."""
        inside_s = sum(planned.job.limit_s for planned in self.inside(scene))
        return driving.drive_job(scene, self.motion, inside_s, self._name_pattern)

    @property
    def _name_pattern(self) -> str:
        """Pattern of the names of jobs and files, see `driving.drive_job`."""
        return self.prefixed_name("{}")

    @property
    def _log(self) -> str:
        return self.prefixed_name(drive_log.FILE)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        robot = scene.robot(self.robot)
        driving_note = ""
        if (drive := drive_of(robot.profile)) is not None and can_drive(robot):
            driving_note = (
                f", and back, automatically: velocities on {drive.topic}, odometry of {drive.odometry}; it stops if "
                f"no order arrives for {drive.lease:g} s, and at {robot.profile.limits.fence_m:g} m from its origin"
            )
        duration = f"for up to {round(self.path_s(robot), 1):g} s"
        yield f"{robot.name} moves {geometry.describe_move(self.motion)}, {duration}{driving_note}"

    @override
    def abort_notes(self, scene: Scene) -> Iterator[str]:
        if can_drive(scene.robot(self.robot)):
            yield f"{scene.robot(self.robot).name} stops where it is"

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        robot = scene.robot(self.robot)
        fastest_m_s = robot.profile.limits.max_speed_m_s
        speed_m_s = self.motion.speed_m_s
        if speed_m_s > fastest_m_s:
            yield Refusal(
                self.robot,
                f"its top speed is {fastest_m_s:g} m/s, but the move needs {speed_m_s:g} m/s",
                "reduce the speed in the procedure, or write within_limits: true; the limit is "
                "limits.max_speed_m_s in its profile",
            )
        if can_drive(robot):
            yield from driving.refusals(scene, self.motion)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        """Return the size of the log of a driving robot, which covers the path, the steps inside and the return."""
        robot = scene.robot(role)
        if role != self.robot or not can_drive(robot) or drive_of(robot.profile) is None:
            return 0.0
        return _LOG_BYTES_PER_S * (2 * self.path_s(robot) + self.inside_s(scene.protocol))

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the check of the middleware's Python package for a robot that drives automatically."""
        robot = scene.robot(self.robot)
        if can_drive(robot):
            yield stream_options.need(self.robot, robot, driving.middleware_of(robot))

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        robot = scene.robot(self.robot)
        announce(f"move {robot.name}", None)
        if can_drive(robot):
            with driving.drive_robot(
                scene, testbed, self._driving(scene), self.motion, self._name_pattern
            ) as drive_lease:
                run_inside(self, drive_lease, scene, testbed, announce)
                announce(f"drive {robot.name} back", self.path_s(robot))
            return
        with testbed.moving(self.motion):
            for entry in self.during:
                entry.step.run(scene, testbed, announce)

    @override
    def moves(self) -> frozenset[Role]:
        return frozenset({self.robot})

    @override
    def files(self) -> tuple[str, ...]:
        """Return the files of the driver, which exist only if the robot drives automatically."""
        return driving.files(self._name_pattern)

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of the drive if `driven` is set, as for every robot that drives automatically."""
        return drive_log.COLUMNS if self.driven else ()

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if the log of the drive is damaged or contradicts the plan."""
        if not (self.driven and can_drive(view.scene.robot(self.robot))):
            return
        try:
            log = view.evidence.read(drive_log.read, self._log)
            damage = view.evidence.read(motion_log.numbered_lines_problem, self._log)
        except EvidenceError as error:
            yield f"{self._log}: {error.what}"
            return
        motion = self.motion
        plan = drive_checks.DrivePlan(motion.legs, motion.speed_m_s, view.attempt_window(self.robot))
        reasons = [damage] if damage else drive_checks.contradictions(log, plan)
        yield from (f"{self._log}: {reason}" for reason in reasons)

    @override
    def measure(self, view: View) -> Measured:
        """Return the values of the drive, without values that other sources of the robot's position contradict."""
        if not self.driven:
            return Measured()
        log = view.evidence.read_or_none(drive_log.read, self._log)
        measured = drive_log.measure(log)
        if log is None:
            return measured
        during_ns = (log[0].utc_ns, log[-1].utc_ns) if log[0].utc_ns else None
        away_m = max(moment.distance_m for moment in log)
        reason = recorded_positions.travel_contradiction(
            view.evidence, self.robot, away_m, self.motion.speed_m_s, during_ns
        )
        return (
            measured.without({name: reason for name in measured.values if name != "drive_ended"})
            if reason
            else measured
        )

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(driven_m := values.get("drive_out_m"), float):
            yield f"drove {driven_m:.1f} m"

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        if any(nest.disturbs for nest in within):
            return "a move must not be inside a fault: put the fault into the move"
        if any(nest.parallel for nest in within):
            return "a move must not be inside a together: put the together into the move"
        return None

    @override
    def may_prompt(self) -> bool:
        return True

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.inside_s(protocol) + (self.straight_s if self.driven else 0.0)

"""Fly a drone over MAVLink while other steps run, within the limits of its profile; it lands at the end."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, ClassVar, Final

from typing_extensions import override

from fieldkit.agent.flying.flight_plan import AT_PATH_START, CLIMB, GO, HOME, ON_GROUND, FlightPlan
from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Length, Speed
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Control, Protocol, Role
from fieldkit.core.units import format_duration
from fieldkit.motion.abort_actions import OnAbort, abort_of
from fieldkit.motion.logs import fly_checks, fly_log, motion_log, motion_sources
from fieldkit.motion.origins import origins_of
from fieldkit.motion.profile_sections import can_fly, mavlink_of
from fieldkit.motion.steps import piloting
from fieldkit.motion.steps.arming_need import arming_need
from fieldkit.motion.steps.flight_alarm import alarm_after_failure
from fieldkit.motion.steps.flight_rescue import FlightRescue
from fieldkit.motion.steps.lease import orders_file, run_inside
from fieldkit.motion.steps.link_need import link_need
from fieldkit.motion.steps.mavlink import MavlinkStep
from fieldkit.remote.shell import Shell
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import (
    ChecksPlacement,
    DescribesActions,
    HasNeeds,
    HasRefusals,
    Moves,
    Summarizes,
    UsesSpace,
)
from fieldkit.steps.legs import PathLeg
from fieldkit.steps.nest import Nest, steps_inside
from fieldkit.steps.scene import Announce, Need, Planned, Refusal, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.view import View

_Distance = Annotated[Length, Field(gt=0)] | None

_START_TIMEOUT_S: Final = 60.0
"""Timeout until the motors are off and the position is known; after an aborted attempt the drone may still be
landing."""
_SLACK_S: Final = 30.0
"""Additional time of a take-off for the change of mode, the motors and the last metre; the same for a landing."""
_SLOWEST_M_S: Final = 0.3
"""Lower bound of the landing speed. PX4 lands at 0.7 m/s (MPC_LAND_SPEED), slower near the ground (MPC_LAND_CRWL)."""
_LIMIT_MARGIN_S: Final = 3600.0
"""Difference between the time limit of the pilot's job and the expected duration of the flight."""
_AT_REST_S: Final = 3.0
"""Approximate time that the log covers before the take-off and after the landing."""
_LOG_BYTES_PER_S: Final = 2200.0
"""Growth of the log: ten lines a second (`agent/flying/flight_log.py`), each of about 220 bytes."""


class FlyLeg(PathLeg):
    """A straight segment of a path in the air; several keys together are one diagonal segment.

    Attributes:
        away: Distance forward, in the direction of the drone's nose before its first take-off in the trial.
        towards: Distance backward.
        left: Distance to the left of that direction.
        right: Distance to the right of that direction.
        up: Distance up.
        down: Distance down, but not to the ground.
    """

    opposites: ClassVar[tuple[tuple[str, str], ...]] = (*PathLeg.opposites, ("up", "down"))

    up: _Distance = None
    down: _Distance = None

    @property
    def metres(self) -> tuple[float, float, float]:
        """Distances forward, to the left and up, in metres."""
        return self.leg.away_m, self.leg.left_m, (self.up or 0.0) - (self.down or 0.0)


class FlyStep(Nest, DescribesActions, Moves, ChecksPlacement, HasRefusals, HasNeeds, UsesSpace, Summarizes):
    """Makes a drone take off, fly its path while the steps in `during` run, and land.

    See [MAVLink](mavlink.md#fly-in-a-procedure). When the steps in `during` have ended, the drone returns or lands,
    even if it has not reached the end of its path. Forward is the direction of its nose before its first take-off in
    the trial: place it with its nose away from the robot at the other end of its link. Real drones need
    `--allow-motion`. A flight beyond `limits` of the profile is refused, and so is a robot whose profile has no
    `mavlink`. Before the trial and before each take-off its autopilot, PX4 or ArduCopter, must report [that it can be
    armed](mavlink.md#checks-before-a-take-off). A `fault` or a `together` may be inside a flight; a
    flight must not be inside a `fault` or a `together`. Adds columns of the flight (`fly_height_median_m` and others,
    [MAVLink](mavlink.md#evidence-of-a-flight)). Writes `fly.jsonl`, and logs and orders of the programs on the drone:
    `fly.log`, `fly.orders`, `guard.log`, `guard.orders` and, if it was needed, `rescue.log`.

    Attributes:
        robot: Role that flies.
        height: Height above the take-off point to which it climbs first. This height and the height of every corner
            of the path must be at most `limits.max_height_m`.
        path: Its path after the climb, a list of straight segments. Without a path it hovers; at the end of the path
            it waits until the steps in `during` have ended. The horizontal distance of every corner from the take-off
            point must be at most `limits.fence_m`.
        speed: Speed, at most `limits.max_speed_m_s`.
        climb: Rate of climb, at most `limits.max_speed_m_s`.
        then: End of the flight: `return` to the take-off point, or `land` at the current position.
        lease: Time for which it continues without contact to the laptop, 3 s to 10 min; then it performs the action
            of `on_abort`, or lands. With `control: radio`, twice the expected time of the steps is added.
        during: Steps that run in order while the drone flies its path.
    """

    cross_checks = motion_sources.OF_FLIGHT

    robot: Role
    height: Annotated[Length, Field(gt=0)]
    path: tuple[FlyLeg, ...] = ()
    speed: Annotated[Speed, Field(gt=0)] = 1.0
    climb: Annotated[Speed, Field(gt=0)] = 1.0
    then: OnAbort = OnAbort.RETURN
    lease: Annotated[Duration, Field(ge=3, le=600)] = piloting.LEASE_S
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _stays_in_the_air(self) -> "FlyStep":
        if min(up_m for _, _, up_m in self._corners_m()) <= 0:
            raise schema.validation_error("the path leads to the ground, or below it", "path")
        return self

    def _corners_m(self) -> list[tuple[float, float, float]]:
        """Return the corners of the path relative to the take-off point, in metres: forward, left, up."""
        away_m, left_m, up_m = 0.0, 0.0, self.height
        corners = [(away_m, left_m, up_m)]
        for leg in self.path:
            away_m, left_m, up_m = (a + b for a, b in zip((away_m, left_m, up_m), leg.metres, strict=True))
            corners.append((away_m, left_m, up_m))
        return corners

    @property
    def _farthest_m(self) -> float:
        """Maximum horizontal distance of a corner from the take-off point."""
        return max(math.hypot(*corner[:2]) for corner in self._corners_m())

    @property
    def _highest_m(self) -> float:
        return max(up_m for _, _, up_m in self._corners_m())

    @property
    def _climb_s(self) -> float:
        return self.height / self.climb

    @property
    def _descent_s(self) -> float:
        return self._farthest_m / self.speed + self._highest_m / _SLOWEST_M_S

    def _plan(self, scene: Scene) -> FlightPlan:
        profile = scene.robot(self.robot).profile
        limits, mavlink = profile.limits, mavlink_of(profile)
        origin = origins_of(scene).get(self.robot)
        return FlightPlan(
            connection=piloting.onboard_connection(scene.robot(self.robot)),
            orders=orders_file(self.prefixed_name("fly")),
            abort=abort_of(scene, self.robot).value,
            lease_s=self.lease,
            end=self.then.value,
            height_m=self.height,
            legs=[leg.metres for leg in self.path],
            speed_m_s=self.speed,
            climb_m_s=self.climb,
            ceiling_m=limits.max_height_m or 0.0,
            fence_m=limits.fence_m or 0.0,
            least_charge=mavlink.least_charge if mavlink else 0.0,
            origin=None if origin is None else asdict(origin),
            log=self._log,
            liveness=piloting.liveness_file(self.prefixed_name("guard")),
        )

    @property
    def _log(self) -> str:
        return self.prefixed_name(fly_log.FILE)

    def _pilot(self, scene: Scene) -> Planned:
        """Return the job of the pilot, the program that flies the drone."""
        limit_s = _LIMIT_MARGIN_S + self.expected_s(scene.protocol)
        return piloting.flight_job(scene, self.robot, self.prefixed_name("fly"), self._plan(scene), limit_s)

    @property
    def _lease_s(self) -> float:
        """Lease of the guard, which must not expire before the lease of the pilot."""
        return max(self.lease, piloting.LEASE_S)

    def _guard(self, scene: Scene) -> Planned:
        """Return the job of the guard, which ends the flight if the pilot fails or the attempt is aborted."""
        return piloting.guard_job(
            scene,
            self.robot,
            self.prefixed_name("guard"),
            abort=abort_of(scene, self.robot).value,
            lease_s=self._lease_s,
            has_pilot=True,
        )

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        if mavlink_of(scene.robot(self.robot).profile) is not None:  # otherwise `refusals` reports it
            yield self._guard(scene)
            yield self._pilot(scene)
        yield from self.inside(scene)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        path_m = sum(math.hypot(*leg.metres) for leg in self.path)
        name, then = scene.robot(self.robot).name, {"return": "returns", "land": "lands there"}[self.then]
        flight = f"climbs to {self.height:g} m, flies {path_m:g} m at {self.speed:g} m/s, and {then}"
        yield f"{name} {flight}; after an abort, for example by Ctrl-C, it {self._abort_action(scene)}"

    def _abort_action(self, scene: Scene) -> str:
        return {"return": "returns automatically", "land": "lands"}[abort_of(scene, self.robot)]

    @override
    def abort_notes(self, scene: Scene) -> Iterator[str]:
        duration = format_duration(self._descent_s + _SLACK_S)
        note = f"if it is in the air; this takes up to about {duration}, and continues if fieldkit exits"
        yield f"{scene.robot(self.robot).name} {self._abort_action(scene)} {note}"

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """Yield a reason for a missing section `mavlink` or permission, and for each limit exceeded or missing."""
        profile, name = scene.robot(self.robot).profile, scene.robot(self.robot).profile.name
        limits = profile.limits
        if mavlink_of(profile) is None:
            yield Refusal(self.robot, "it cannot fly: its profile has no mavlink", "use a drone in this role")
        elif not can_fly(scene.robot(self.robot)):
            remedy = "use --allow-motion if its path is clear and a pilot can take over; see: fieldkit docs mavlink"
            yield Refusal(self.robot, "it is a real drone, and flights are not allowed", remedy)
        for quantity, planned_m, limit_m, key in (
            ("height", self._highest_m, limits.max_height_m, "max_height_m"),
            ("distance from the take-off point", self._farthest_m, limits.fence_m, "fence_m"),
        ):
            if limit_m is None:
                reason = f"its profile has no limit for the {quantity}"
                yield Refusal(self.robot, reason, f"write limits: {{{key}: ...}} in robots/{name}.yaml")
            elif planned_m > limit_m:
                reason = f"its {quantity} is limited to {limit_m:g} m, but the flight needs {planned_m:g} m"
                yield Refusal(
                    self.robot, reason, f"reduce it in the procedure; the limit is limits.{key} in its profile"
                )
        speed_m_s = max(self.speed, self.climb)
        if speed_m_s > limits.max_speed_m_s:
            reason = f"its top speed is {limits.max_speed_m_s:g} m/s, but the flight needs {speed_m_s:g} m/s"
            remedy = "reduce the speed in the procedure; the limit is limits.max_speed_m_s in its profile"
            yield Refusal(self.robot, reason, remedy)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        """Return the size of the log, which covers the time from before the take-off until the motors are off."""
        duration_s = self.expected_s(scene.protocol) + _AT_REST_S
        return _LOG_BYTES_PER_S * duration_s if role == self.robot else 0.0

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the checks that the autopilot can be reached, and that it can be armed for this flight."""
        robot = scene.robot(self.robot)
        # Missing keys of the profile are reported by `refusals`.
        if mavlink_of(robot.profile) is not None and robot.profile.limits.max_height_m is not None:
            plan = self._plan(scene)
            yield link_need(robot, self.robot, plan.connection, ("pilot", "guard"))
            yield arming_need(robot, self.robot, plan)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        shell, guard = testbed.shells[self.robot], self._guard(scene)
        flight_s, body_s = self.expected_s(scene.protocol), self.inside_s(scene.protocol)
        with (
            piloting.guarding(scene, shell, guard, lease_s=self._lease_s, body_s=flight_s),
            piloting.leased_program(
                scene, shell, self._pilot(scene), lease_s=self.lease, body_s=body_s, exit_s=_SLACK_S
            ) as flight,
            self._rescue(scene, shell, flight, announce) as rescue,
            alarm_after_failure(flight, guard, rescue, self._log, announce, landing_s=self._descent_s + _SLACK_S),
        ):
            self._fly(scene, testbed, announce, flight)

    def _rescue(self, scene: Scene, shell: Shell, flight: piloting.FlightLease, announce: Announce) -> FlightRescue:
        """Return the rescue, which is inactive if the control connection crosses the radio under test."""

        def raise_alarm(text: str) -> None:
            flight.lost_reason = "neither its pilot nor its guard runs"
            announce(text, None)

        guard_name = self.prefixed_name("guard")
        abort = abort_of(scene, self.robot).value
        job = piloting.rescue_job(scene, self.robot, self.prefixed_name("rescue"), guard_name, abort=abort)
        may_send = scene.robot(self.robot).control is not Control.RADIO
        return FlightRescue(shell, job, piloting.liveness_file(guard_name), raise_alarm, may_send=may_send)

    def _fly(self, scene: Scene, testbed: Testbed, announce: Announce, flight: piloting.FlightLease) -> None:
        """Send the orders of the flight; the origin is stored before the first order that moves the drone."""
        name = scene.robot(self.robot).name
        self._wait_for_start(scene, flight)
        with origins_of(scene).moving(self.robot) as motion:
            announce(f"take off with {name}", self._climb_s)
            flight.give_order(CLIMB)
            flight.wait_for(AT_PATH_START, self._climb_s + _SLACK_S)
            announce(f"fly {name}", None)
            flight.give_order(GO)
            run_inside(self, flight, scene, testbed, announce)
            announce(f"land {name}", self._descent_s)
            flight.give_order(HOME)
            flight.wait_for("landed", self._descent_s + _SLACK_S)
            motion.mark_ended()

    def _wait_for_start(self, scene: Scene, flight: piloting.FlightLease) -> None:
        """Wait until the drone is ready at its origin; record the origin before the first start."""
        try:
            flight.wait_for(ON_GROUND, _START_TIMEOUT_S)
        except RobotError as error:
            if flight.is_misplaced:
                origins_of(scene).refuse(self.robot, error.what)
            raise
        if origins_of(scene).get(self.robot) is None:
            origins_of(scene).record(self.robot, flight.origin())

    @override
    def moves(self) -> frozenset[Role]:
        return frozenset({self.robot})

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ("a flight",)

    @override
    def files(self) -> tuple[str, ...]:
        name = self.prefixed_name("fly")
        guard = self.prefixed_name("guard")
        rescue = self.prefixed_name("rescue")
        return (f"{name}.log", orders_file(name), self._log, f"{guard}.log", orders_file(guard), f"{rescue}.log")

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of a flight, which only trials with a flight have."""
        return fly_log.COLUMNS

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if the log of the flight is damaged, or contradicts the plan or the telemetry."""
        try:
            log = view.evidence.read(fly_log.read, self._log)
            damage = view.evidence.read(motion_log.numbered_lines_problem, self._log)
        except EvidenceError as error:
            yield f"{self._log}: {error.what}"
            return
        limits = view.scene.robot(self.robot).profile.limits
        plan = fly_checks.FlyPlan(
            highest_m=self._highest_m,
            farthest_m=self._farthest_m,
            fastest_m_s=max(self.speed, self.climb, limits.max_speed_m_s),
            window=view.attempt_window(self.robot),
        )
        reasons = [damage] if damage else list(fly_checks.contradictions(log, plan))
        for step in (*view.within, *steps_inside(self)):
            if isinstance(step, MavlinkStep) and step.robot == self.robot and not reasons:
                reasons += filter(None, (fly_checks.telemetry_contradiction(log, step.places_m(view)),))
        yield from (f"{self._log}: {reason}" for reason in reasons)

    @override
    def measure(self, view: View) -> Measured:
        return fly_log.measure(view.evidence.read_or_none(fly_log.read, self._log))

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(farthest_m := values.get("fly_farthest_m"), float):
            yield f"flew {farthest_m:.1f} m away"
        if isinstance(height_m := values.get("fly_height_median_m"), float):
            yield f"{height_m:.1f} m high"

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        if any(nest.disturbs for nest in within):
            return "a flight must not be inside a fault: put the fault into the flight"
        if any(nest.parallel for nest in within):
            return "a flight must not be inside a together: put the together into the flight"
        return None

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self._climb_s + self.inside_s(protocol) + self._descent_s

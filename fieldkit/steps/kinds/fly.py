"""Fly a drone over MAVLink while other steps run, within the limits of its profile; it comes down at the end."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Final

from typing_extensions import override

from fieldkit.agent.flight_plan import CLIMB, GO, HOME, FlightPlan
from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Length, Speed
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Control, OnAbort, Protocol, Role
from fieldkit.core.units import format_duration
from fieldkit.measure.evidence import numbered_lines
from fieldkit.measure.motion import fly_checks, fly_log, motion_sources
from fieldkit.remote.shell import Shell
from fieldkit.steps import piloting
from fieldkit.steps.arming_need import arming_need
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.flight_alarm import alarmed
from fieldkit.steps.flight_rescue import FlightRescue
from fieldkit.steps.kinds import follow
from fieldkit.steps.kinds.mavlink import MavlinkStep
from fieldkit.steps.kinds.move import PathLeg
from fieldkit.steps.lease import orders_file, run_inside
from fieldkit.steps.link_need import link_need
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Announce, Need, Planned, Refusal, Scene
from fieldkit.steps.view import View

_Way = Annotated[Length, Field(gt=0)] | None

STANDS_S: Final = 60.0
"""How long its motors may go on turning: after an attempt that was cut short it is still coming down."""
_SLACK_S: Final = 30.0
"""For the mode, the motors and the last metre of a flight, and as much again where it lands."""
_SLOWEST_M_S: Final = 0.3
"""PX4's land speed is 0.7 m/s (MPC_LAND_SPEED), and less near the ground (MPC_LAND_CRWL)."""
_LIMIT_S: Final = 3600.0
_AT_REST_S: Final = 3.0
"""About how long the log has lines of a drone that has not risen yet or has landed."""
_LOG_BYTES_PER_S: Final = 2200.0
"""Ten lines a second (`agent/flight_log.py`), each of about 200 bytes."""


class FlyLeg(PathLeg):
    """A straight piece of a way in the air; along, across and up together are a slant.

    Attributes:
        up: Distance up; the keys of one entry together are one diagonal segment.
        down: Distance down, but not to the ground.
    """

    up: _Way = None
    down: _Way = None

    @schema.model_validator(mode="after")
    def _one_direction(self) -> "FlyLeg":
        for one, other in (("away", "towards"), ("left", "right"), ("up", "down")):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise schema.complaint(f"a piece of a way goes {one} or {other}; make two pieces", other)
        if not any((self.away, self.towards, self.left, self.right, self.up, self.down)):
            raise schema.complaint("say how far, and whether away, towards, left, right, up or down")
        return self

    @property
    def metres(self) -> tuple[float, float, float]:
        """How far away, to the left and up."""
        return self.leg.away_m, self.leg.left_m, (self.up or 0.0) - (self.down or 0.0)


class FlyStep(Nest):
    """Lets a drone take off, fly its path while the steps in `during` run, and land.

    See [MAVLink](mavlink.md#fly-in-a-procedure). Forward is where its nose points before take-off: place it with its
    nose away from the robot at the other end of its link. Real drones need `--allow-motion`. A flight beyond `limits`
    of the profile is refused, and so is a robot whose profile has no `mavlink`. Before the trial and before each
    take-off its autopilot, PX4 or ArduCopter, must report [that it can be
    armed](mavlink.md#checks-before-a-take-off). A `fault` or a `together` may be inside a flight, but not a
    flight inside them. Adds columns of the flight (`fly_height_median_m` and others,
    [MAVLink](mavlink.md#what-a-flight-leaves)). Leaves `fly.jsonl`, `fly.log` and `fly.orders`.

    Attributes:
        robot: Role that flies.
        height: Height above the take-off point to which it climbs first; together with all segments upwards at most
            `limits.max_height_m`.
        path: Its path then, a list of straight segments; forward is where its nose points before take-off. Without a
            path it hovers; at the end of the path it waits. Every corner must be within `limits.fence_m` of the
            take-off point.
        speed: Speed, at most `limits.max_speed_m_s`.
        climb: Rate of climb, at most `limits.max_speed_m_s`.
        then: Where it lands: `return` to the take-off point, or `land` where it is.
        lease: How long it continues without contact to the laptop, 3 s to 10 min; then it does what `on_abort` says,
            or lands.
        during: Steps that run meanwhile.
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
            raise schema.complaint("its way leads to the ground, or below it", "path")
        return self

    def _corners_m(self) -> list[tuple[float, float, float]]:
        """Return the points of its way, seen from where it stands: away, to the left, up."""
        away_m, left_m, up_m = 0.0, 0.0, self.height
        found = [(away_m, left_m, up_m)]
        for leg in self.path:
            away_m, left_m, up_m = (a + b for a, b in zip((away_m, left_m, up_m), leg.metres, strict=True))
            found.append((away_m, left_m, up_m))
        return found

    @property
    def _back_m(self) -> float:
        """How far its way is at the end of it, at most, from where it rose."""
        return max(math.hypot(*corner[:2]) for corner in self._corners_m())

    @property
    def _highest_m(self) -> float:
        return max(up_m for _, _, up_m in self._corners_m())

    @property
    def _rises_s(self) -> float:
        return self.height / self.climb

    @property
    def _comes_down_s(self) -> float:
        return self._back_m / self.speed + self._highest_m / _SLOWEST_M_S

    def _plan(self, scene: Scene) -> FlightPlan:
        limits, mavlink = scene.robot(self.robot).profile.limits, scene.robot(self.robot).profile.mavlink
        origin = scene.origins.get(self.robot)
        return FlightPlan(
            connection=piloting.connection(scene.robot(self.robot)),
            orders=orders_file(self.own_name("fly")),
            abort=piloting.abort_of(scene, self.robot).value,
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
            liveness=piloting.liveness_file(self.own_name("guard")),
        )

    @property
    def _log(self) -> str:
        return self.own_name(fly_log.FILE)

    def _pilot(self, scene: Scene) -> Planned:
        limit_s = _LIMIT_S + self.expected_s(scene.protocol)
        return piloting.planned(scene, self.robot, self.own_name("fly"), self._plan(scene), limit_s)

    @property
    def _lease_s(self) -> float:
        """The lease of the guard, which must not end before the pilot's."""
        return max(self.lease, piloting.LEASE_S)

    def _guard(self, scene: Scene) -> Planned:
        return piloting.guard(scene, self.robot, self.own_name("guard"), lease_s=self._lease_s, flown=True)

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        if scene.robot(self.robot).profile.mavlink is not None:  # it is refused then
            yield self._guard(scene)
            yield self._pilot(scene)
        yield from self.inside(scene)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        way_m = sum(math.hypot(*leg.metres) for leg in self.path)
        name, then = scene.robot(self.robot).name, {"return": "comes back", "land": "lands there"}[self.then]
        way = f"rises to {self.height:g} m, flies {way_m:g} m at {self.speed:g} m/s, and {then}"
        yield f"{name} {way}; cut short, by Ctrl-C for example, it {self._given_up(scene)}"
        yield from super().dry_run_notes(scene)

    def _given_up(self, scene: Scene) -> str:
        return {"return": "returns by itself", "land": "lands"}[piloting.abort_of(scene, self.robot)]

    @override
    def abort_notes(self, scene: Scene) -> Iterator[str]:
        takes = format_duration(self._comes_down_s + _SLACK_S)
        when = f"if it is in the air: for up to about {takes}, also when fieldkit has ended"
        yield f"{scene.robot(self.robot).name} {self._given_up(scene)}, {when}"
        yield from super().abort_notes(scene)

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """It flies within the limits of its profile, or not at all."""
        profile, name = scene.robot(self.robot).profile, scene.robot(self.robot).profile.name
        limits = profile.limits
        if profile.mavlink is None:
            yield Refusal(self.robot, "its profile has no mavlink: nothing flies it", "a drone in this role")
        elif not scene.robot(self.robot).flies:
            remedy = "--allow-motion, where its way is free and somebody can take it over; see: fieldkit docs mavlink"
            yield Refusal(self.robot, "it is real, and fieldkit is to fly it", remedy)
        for what, asked, most, key in (
            ("high", self._highest_m, limits.max_height_m, "max_height_m"),
            ("far from where it rises", self._back_m, limits.fence_m, "fence_m"),
        ):
            if most is None:
                why = f"its profile does not say how {what} it may fly"
                yield Refusal(self.robot, why, f"limits: {{{key}: ...}} in robots/{name}.yaml")
            elif asked > most:
                why = f"it may fly {most:g} m {what}, and it is to fly {asked:g} m"
                yield Refusal(self.robot, why, f"less in the procedure; limits.{key} in its profile says it")
        speed_m_s = max(self.speed, self.climb)
        if speed_m_s > limits.max_speed_m_s:
            why = f"its top speed is {limits.max_speed_m_s:g} m/s, and it is to fly at {speed_m_s:g} m/s"
            remedy = "a lower speed in the procedure; limits.max_speed_m_s in its profile says it"
            yield Refusal(self.robot, why, remedy)
        yield from super().refusals(scene)

    @override
    def bytes_left(self, scene: Scene, role: Role) -> float:
        """Its log has lines from before the drone rises until its motors have stopped."""
        lasts_s = self.expected_s(scene.protocol) + _AT_REST_S
        return _LOG_BYTES_PER_S * lasts_s if role == self.robot else 0.0

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """An autopilot that may be armed for this flight."""
        robot = scene.robot(self.robot)
        if robot.profile.mavlink is not None and robot.profile.limits.max_height_m is not None:  # refused otherwise
            plan = self._plan(scene)
            yield link_need(robot, self.robot, plan.connection, ("pilot", "guard"))
            yield arming_need(robot, self.robot, plan)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        shell, guard = testbed.shells[self.robot], self._guard(scene)
        flight_s, body_s = self.expected_s(scene.protocol), self.inside_s(scene.protocol)
        with (
            piloting.guarding(scene, shell, guard, lease_s=self._lease_s, body_s=flight_s),
            piloting.leashed(
                scene, shell, self._pilot(scene), lease_s=self.lease, body_s=body_s, ends_s=_SLACK_S
            ) as leash,
            self._rescue(scene, shell, leash, announce) as rescue,
            alarmed(leash, guard, rescue, self._log, announce, lands_s=self._comes_down_s + _SLACK_S),
        ):
            self._fly(scene, testbed, announce, leash)

    def _rescue(self, scene: Scene, shell: Shell, leash: piloting.Leash, announce: Announce) -> FlightRescue:
        """Return the rescue of the drone; nothing may be sent over a radio under test."""

        def lose(text: str) -> None:
            leash.lost = "neither its pilot nor its guard runs"
            announce(text, None)

        guard_name = self.own_name("guard")
        job = piloting.rescue(scene, self.robot, self.own_name("rescue"), guard_name)
        sends = scene.robot(self.robot).control is not Control.RADIO
        return FlightRescue(shell, job, piloting.liveness_file(guard_name), lose, sends=sends)

    def _fly(self, scene: Scene, testbed: Testbed, announce: Announce, leash: piloting.Leash) -> None:
        """Give the orders of the flight; the origin is stored before the first one that moves the drone."""
        name = scene.robot(self.robot).name
        self._wait_for_start(scene, leash)
        with scene.origins.moving(self.robot) as motion:
            announce(f"take off with {name}", self._rises_s)
            leash.order(CLIMB)
            leash.until("up", self._rises_s + _SLACK_S)
            announce(f"fly {name}", None)
            leash.order(GO)
            run_inside(self, leash, scene, testbed, announce)
            announce(f"land {name}", self._comes_down_s)
            leash.order(HOME)
            leash.until("landed", self._comes_down_s + _SLACK_S)
            motion.ended()

    def _wait_for_start(self, scene: Scene, leash: piloting.Leash) -> None:
        """Wait until the drone is ready at its origin; record the origin of a first start."""
        try:
            leash.until("standing", STANDS_S)
        except RobotError as error:
            if leash.is_misplaced:
                scene.origins.refuse(self.robot, error.what)
            raise
        if scene.origins.get(self.robot) is None:
            scene.origins.record(self.robot, leash.origin())

    @override
    def moves(self) -> frozenset[Role]:
        return frozenset({self.robot})

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ("a flight",)

    @override
    def files(self) -> tuple[str, ...]:
        name = self.own_name("fly")
        guard = self.own_name("guard")
        rescue = self.own_name("rescue")
        return (f"{name}.log", orders_file(name), self._log, f"{guard}.log", orders_file(guard), f"{rescue}.log")

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """A trial without a flight has no columns for it."""
        return fly_log.COLUMNS

    @override
    def check(self, view: View) -> Iterator[str]:
        """Where it flew is written down, and it can have flown so."""
        try:
            log = view.evidence.read(fly_log.read, self._log)
            damage = view.evidence.read(numbered_lines.problem, self._log)
        except EvidenceError as error:
            yield f"{self._log}: {error.what}"
            return
        limits = view.scene.robot(self.robot).profile.limits
        plan = fly_checks.FlyPlan(
            highest_m=self._highest_m,
            farthest_m=self._back_m,
            fastest_m_s=max(self.speed, self.climb, limits.max_speed_m_s),
            window=view.attempt_window(self.robot),
        )
        reasons = [damage] if damage else list(fly_checks.contradictions(log, plan))
        for step in (*view.within, *follow.steps_inside(self)):
            if isinstance(step, MavlinkStep) and step.robot == self.robot and not reasons:
                reasons += filter(None, (fly_checks.of_telemetry(log, step.places_m(view)),))
        yield from (f"{self._log}: {why}" for why in reasons)

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
    def placement_error(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:
        if any(nest.disturbs for nest in within):
            return "a fault has no flight inside: put the fault into the flight"
        if any(nest.parallel for nest in within):
            return "a flight does not stand in together: put together into the flight"
        return None

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self._rises_s + self.inside_s(protocol) + self._comes_down_s

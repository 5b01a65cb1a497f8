"""Fly a drone over MAVLink while other steps run, within the limits of its profile; it comes down at the end."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Final

from fieldkit.agent.flight_plan import CLIMB, GO, HOME, FlightPlan
from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Length, Speed
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import OnAbort, Protocol, Role, Verdict
from fieldkit.core.text import JSON_ERRORS, harmless
from fieldkit.core.units import format_duration
from fieldkit.measure.evidence import fly_log
from fieldkit.remote import agent
from fieldkit.steps import piloting, streams
from fieldkit.steps.base import Nest, Step, StepEntry, View
from fieldkit.steps.kinds.move import PathLeg
from fieldkit.steps.lease import orders_file, run_inside
from fieldkit.steps.scene import Announce, Need, Planned, Refusal, Said, Scene

_Way = Annotated[Length, Field(gt=0)] | None

STANDS_S: Final = 60.0
"""How long its motors may go on turning: after an attempt that was cut short it is still coming down."""
_SLACK_S: Final = 30.0
"""For the mode, the motors and the last metre of a flight, and as much again where it lands."""
_SLOWEST_M_S: Final = 0.3
"""PX4's land speed is 0.7 m/s (MPC_LAND_SPEED), and less near the ground (MPC_LAND_CRWL)."""
_LIMIT_S: Final = 3600.0


class FlyLeg(PathLeg):
    """A straight piece of a way in the air; along, across and up together are a slant.

    Attributes:
        up: So far up.
        down: So far down.
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
    """A drone rises, flies its way while other steps run, and comes down.

    Attributes:
        robot: Which.
        height: To which height it rises first, above where it stands.
        path: Its way then, piece by piece, as its nose points before it rises; that is away. At its end it waits.
        speed: How fast it flies it.
        climb: How fast it rises.
        then: Where it comes down: `return` to where it rose, or `land` where it is.
        lease: For how long it goes on without the laptop.
        during: The steps inside.
    """

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
            least_charge=mavlink.least_charge if mavlink else 0.0,
            log=self._log,
        )

    @property
    def _log(self) -> str:
        return self.own_name(fly_log.FILE)

    def _pilot(self, scene: Scene) -> Planned:
        limit_s = _LIMIT_S + self.expected_s(scene.protocol)
        return piloting.planned(scene, self.robot, self.own_name("fly"), self._plan(scene), limit_s)

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        if scene.robot(self.robot).profile.mavlink is not None:  # it is refused then
            yield self._pilot(scene)
        yield from self.inside(scene)

    def beside(self, scene: Scene) -> Iterator[str]:
        """See `Step.beside`."""
        way_m = sum(math.hypot(*leg.metres) for leg in self.path)
        name, then = scene.robot(self.robot).name, {"return": "comes back", "land": "lands there"}[self.then]
        way = f"rises to {self.height:g} m, flies {way_m:g} m at {self.speed:g} m/s, and {then}"
        yield f"{name} {way}; cut short, by Ctrl-C twice for example, it {self._given_up(scene)}"
        yield from super().beside(scene)

    def _given_up(self, scene: Scene) -> str:
        return {"return": "returns by itself", "land": "lands"}[piloting.abort_of(scene, self.robot)]

    def cut_short(self, scene: Scene) -> Iterator[str]:
        """See `Step.cut_short`."""
        takes = format_duration(self._comes_down_s + _SLACK_S)
        when = f"if it is in the air: for up to about {takes}, also when fieldkit has ended"
        yield f"{scene.robot(self.robot).name} {self._given_up(scene)}, {when}"
        yield from super().cut_short(scene)

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`: it flies within the limits of its profile, or not at all."""
        profile, name = scene.robot(self.robot).profile, scene.robot(self.robot).profile.name
        limits = profile.limits
        if profile.mavlink is None:
            yield Refusal(self.robot, "its profile has no mavlink: nothing flies it", "a drone in this role")
        elif not scene.robot(self.robot).flies:
            remedy = "--allow-motion, where its way is free and somebody can take it over; see docs/mavlink.md"
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

    def needs(self, scene: Scene) -> Iterator[Need]:
        """See `Step.needs`: an autopilot that may be armed for this flight."""
        robot = scene.robot(self.robot)
        if robot.profile.mavlink is not None and robot.profile.limits.max_height_m is not None:  # refused otherwise
            plan = self._plan(scene)
            told = streams.compact({"connection": plan.connection, "needs": asdict(plan.needs)})
            argv = streams.python(robot, agent.path_from_home(), "arming", told)
            yield Need(self.robot, "autopilot", argv, _judged, of=robot.profile.tools.python, agent=True)

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        name, one = scene.robot(self.robot).name, self._pilot(scene)
        body_s, ends_s = self.inside_s(scene.protocol), self._comes_down_s + _SLACK_S
        with piloting.leashed(
            scene, testbed.shells[self.robot], one, lease_s=self.lease, body_s=body_s, ends_s=_SLACK_S
        ) as leash:
            leash.until("standing", STANDS_S)
            announce(f"take off with {name}", self._rises_s)
            leash.order(CLIMB)
            leash.until("up", self._rises_s + _SLACK_S)
            announce(f"fly {name}", None)
            leash.order(GO)
            run_inside(self, leash, scene, testbed, announce)
            announce(f"land {name}", self._comes_down_s)
            leash.order(HOME)
            leash.until("landed", ends_s)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.robot}) | self.roles_inside()

    def moves(self) -> frozenset[Role]:
        """See `Step.moves`."""
        return frozenset({self.robot})

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("a flight",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        name = self.own_name("fly")
        return (f"{name}.log", orders_file(name), self._log)

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`; a trial without a flight has no columns for it."""
        return fly_log.COLUMNS

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: where it flew is written down."""
        try:
            view.evidence.read(fly_log.read, self._log)
        except EvidenceError as error:
            yield f"{self._log}: {error.what}"

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        return fly_log.measure(view.evidence.known(fly_log.read, self._log))

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        if isinstance(farthest_m := values.get("fly_farthest_m"), float):
            yield f"flew {farthest_m:.1f} m away"
        if isinstance(height_m := values.get("fly_height_median_m"), float):
            yield f"{height_m:.1f} m high"

    def misplaced(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:  # noqa: ARG002 (see the base)
        """See `Step.misplaced`."""
        if any(nest.disturbs for nest in within):
            return "a fault has no flight inside: put the fault into the flight"
        if any(nest.parallel for nest in within):
            return "a flight does not stand in together: put together into the flight"
        return None

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return self._rises_s + self.inside_s(protocol) + self._comes_down_s


def _judged(said: Said) -> tuple[Verdict, str, str]:
    """Return whether an autopilot answers that can be armed for the flight; grave faults come first."""
    try:
        *faults, told = (json.loads(line) for line in said.text.splitlines())
        faults.sort(key=lambda fault: not fault["grave"])
        what, remedy = ("; ".join(harmless(fault[key]) for fault in faults) for key in ("what", "remedy"))
        name, charge = harmless(told["autopilot"]), told["charge"]
        has = f", its battery has {charge:.0%}" if charge is not None else ""
    except JSON_ERRORS:
        last = (said.text.splitlines() or ["it does not say why"])[-1]
        remedy = (
            "see that it has power, and that its messages reach mavlink.connection or mavlink.port of the profile"
        )
        return (
            Verdict.FAIL,
            harmless(last).removeprefix("error: "),
            f"{remedy} on the robot: mavlink-router, for example",
        )
    if not faults:
        return Verdict.OK, f"{name} says that it may be armed{has}", ""
    return (Verdict.FAIL if faults[0]["grave"] else Verdict.WARN), what, remedy

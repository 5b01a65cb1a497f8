"""Base class of the emulated drone, which combines its airframe, estimates, fence, failsafes and mission."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.failsafes import VehicleState
from sim_backends.emulated.autopilot.fence import Fence
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.flight import Airframe, Guidance, MakeAirframe, limits_within, stop_m
from sim_backends.emulated.autopilot.mission_plan import Mission
from sim_backends.emulated.autopilot.onboard_estimates import Battery, LandDetector, PositionEstimate
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.physics.collisions import Footprint
from sim_backends.physics.robot_limits import QuadrotorLimits


class StatusText(NamedTuple):
    """Severity and text of a STATUSTEXT message."""

    severity: int
    text: str


class VehicleBase:
    """The components of one drone, and its state.

    Args:
        firmware: Family of its autopilot, PX4 or ArduCopter.
        parameters: Its parameters; the vehicle reads the current values.
        limits: Limits of its airframe.
        obstacles: Obstacles in the world, including the floor.
        now_ns: Time of power-on.
        boot_s: Time from power-on until its position estimate has an origin.
        make_airframe: Creates the airframe at a position; None for an airframe that the autopilot itself moves.

    Attributes:
        firmware: Family of its autopilot.
        body: Position and motion, relative to home.
        is_armed: True if its motors turn.
        land_detector: Its detection of take-off and landing.
        mode: Its flight mode.
        mission: The mission of mode MISSION.
        battery: Its battery.
        estimate: Its position estimate.
        fence: Its fence.
        guidance: Its goal and set-points.
        home_m: Home in the world, metres east, north, up: the point where it was armed last. Before it is first
            armed, it is the point where the position estimate got its origin or, before that, where the drone was
            placed.
        failsafes: Its failsafes.
        status_texts: Texts that are not sent yet; the reader clears the list.
    """

    def __init__(
        self,
        firmware: Firmware,
        parameters: Parameters,
        limits: QuadrotorLimits,
        obstacles: Sequence[Footprint],
        now_ns: int,
        *,
        boot_s: float = 0.0,
        make_airframe: MakeAirframe | None = None,
    ) -> None:
        self.firmware = firmware
        self.battery = Battery(now_ns)
        self._parameters = parameters
        self._limits = limits
        self._make_airframe = make_airframe or (
            lambda place_m, facing_rad, at_ns: Airframe(limits, place_m, facing_rad, obstacles, at_ns)
        )
        self.estimate = PositionEstimate(boot_s, firmware.starting_flags)
        self.land_detector = LandDetector(firmware.landed_s)
        self.fence = Fence(parameters)
        self.guidance = Guidance(firmware, parameters)
        self.mission = Mission(firmware.first_item)
        self.status_texts: list[StatusText] = []
        self.home_m: Vector = (0.0, 0.0, 0.0)
        self.place(self.home_m, math.pi / 2, now_ns)  # facing north
        self.boot(now_ns)

    def boot(self, now_ns: int) -> None:
        """Boot: set the mode after power-on, and reset failsafes and origin."""
        self.estimate.boot(now_ns)
        self._next_prearm_ns = now_ns
        self.mode = self.firmware.boot_mode
        self.is_armed = False
        self.failsafes = self.firmware.failsafes(self._parameters)

    def place(self, place_m: Vector, facing_rad: float, now_ns: int) -> None:
        """Put the drone on the ground at another position, as if a person carried it. It keeps its mode."""
        self.body = self._make_airframe(place_m, facing_rad, now_ns)
        if self.estimate.origin_m is None:
            self.home_m = place_m
        self.body.home_m = self.home_m
        self.is_armed = False
        self.guidance.hold(self.body.position_m)
        self.guidance.set_point_ns = None
        self.fence.reset()
        self.land_detector.place(now_ns)

    @property
    def local_m(self) -> Vector | None:
        """Position relative to the origin of its local frame, east, north, up; None before there is an origin."""
        return self.estimate.to_local(self.body.place_m)

    def from_local(self, place_m: Vector) -> Vector | None:
        """Return the position of a point of its local frame relative to home; None before there is an origin."""
        world_m = self.estimate.to_world(place_m)
        if world_m is None:
            return None
        east, north, up = (world - home for world, home in zip(world_m, self.home_m, strict=True))
        return east, north, up

    @property
    def limits(self) -> QuadrotorLimits:
        """Limits of its airframe, within its parameters."""
        return limits_within(self._limits, self._parameters)

    @property
    def arming_errors(self) -> list[str]:
        """Reasons why it cannot be armed; empty if it can."""
        reasons = self.firmware.arming_errors(self._parameters, self.battery) + self.failsafes.arming_errors
        if self.estimate.origin_m is None:
            reasons.append("Need Position Estimate" if self.firmware.is_ardupilot else "ekf2 missing data")
        return reasons

    def report(self, severity: int, text: str) -> None:
        """Add a text that is sent as STATUSTEXT."""
        self.status_texts.append(StatusText(severity, text))

    @property
    def _state(self) -> VehicleState:
        return VehicleState(self.body.now_ns, self.is_armed, self.land_detector.has_landed, self.mode, self.battery)

    def _stop_m(self) -> Vector:
        """Return the position at which it stops if it brakes now, or the nearest point inside the fence."""
        return self.fence.nearest_inside(stop_m(self.body, self.limits))

"""The vehicle: whether its motors may turn, in which mode it flies, and where that takes it.

It knows of no clock and no socket: `advance` says how late it is.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.battery import Battery
from sim_backends.emulated.autopilot.firmware import LANDING, Firmware, Mode
from sim_backends.emulated.autopilot.flight import STEP_NS, Airframe, stop_m, velocity_to
from sim_backends.emulated.autopilot.mission import Mission
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.emulated.autopilot.plan import Item, inside_fence, within_fence
from sim_backends.physics.collisions import Footprint
from sim_backends.physics.quadrotor import QuadrotorLimits

NEAR_M: Final = 0.1
"""As near as this is there."""


class Refused(Exception):  # noqa: N818 (what an autopilot says, and nothing that went wrong)
    """The vehicle does not do it now; the text is for people, and empty where it says nothing."""


class Vehicle:
    """One drone.

    Args:
        firmware: Of which family its autopilot is.
        parameters: Its parameters, of which it reads what they are at each moment.
        can: What its body can do.
        around: What is in its way in the world, the floor too.
        now_ns: When it is switched on.

    Attributes:
        body: Where it is and how it moves, seen from home.
        armed: Whether its motors turn.
        mode: In which mode it flies.
        mission: What it flies in mode MISSION.
        battery: Its battery.
        home_m: Where the lab has put it: its lowest point, metres east, north, up.
        remarks: What it wants to tell people, to be taken out by whoever does.
    """

    def __init__(
        self,
        firmware: Firmware,
        parameters: Parameters,
        can: QuadrotorLimits,
        around: Sequence[Footprint],
        now_ns: int,
    ) -> None:
        self.firmware = firmware
        self.battery = Battery(now_ns)
        self._parameters = parameters
        self._can = can
        self._around = around
        self.mission = Mission(firmware.first_item)
        self.remarks: list[str] = []
        self.place((0.0, 0.0, 0.0), math.pi / 2, now_ns)

    def place(self, home_m: Vector, facing_rad: float, now_ns: int) -> None:
        """Stand in another place, wherever it was: somebody has carried it there."""
        self.home_m = home_m
        self.body = Airframe(self._can, home_m, facing_rad, self._around, now_ns)
        self.armed = False
        self.mode = Mode.LOITER
        self._goal_m: Vector = self.body.position_m
        self._wish: tuple[Vector, bool] = (self.body.position_m, True)
        self._wished_ns: int | None = None
        self._flew = False
        self._stands_ns = now_ns

    @property
    def can(self) -> QuadrotorLimits:
        """What its body can do, as far as its parameters let it."""
        get = self._parameters
        return replace(
            self._can,
            speed_m_s=get["MPC_XY_VEL_MAX"],
            climb_m_s=(get["MPC_Z_VEL_MAX_DN"], get["MPC_Z_VEL_MAX_UP"]),
            acceleration_m_s2=get["MPC_ACC_HOR"],
            climb_m_s2=(get["MPC_ACC_DOWN_MAX"], get["MPC_ACC_UP_MAX"]),
        )

    @property
    def fence_m(self) -> tuple[float, float]:
        """How far from home it flies, over the ground and up."""
        return self._parameters["GF_MAX_HOR_DIST"], self._parameters["GF_MAX_VER_DIST"]

    @property
    def unfit(self) -> list[str]:
        """Why it may not be armed; empty where it may."""
        return self.firmware.unfit(self._parameters, self.battery)

    def check(self) -> None:
        """Say why it may not be armed.

        Raises:
            Refused: It is armed.
        """
        if self.armed:
            raise self._refusal("Prearm checks denied: armed")
        self.remarks += [self.firmware.prearm[0] + why for why in self.unfit]

    def arm(self) -> None:
        """Let the motors turn; once more does nothing.

        Raises:
            Refused: It is to come down, or not fit.
        """
        if self.armed:
            return
        if not self.body.on_ground:
            raise self._refusal("Arming denied: it falls")
        if unfit := self.unfit:
            self.remarks += [self.firmware.prearm[1] + why for why in unfit]
            raise self._refusal("Arming denied: Resolve system health failures first")
        self.armed, self._flew, self._stands_ns = True, False, self.body.now_ns
        self._goal_m = self.body.position_m

    def disarm(self, *, force: bool = False) -> None:
        """Stop the motors.

        Args:
            force: In the air, too: it falls.

        Raises:
            Refused: It flies.
        """
        if self.armed and not self.body.on_ground and not force:
            raise self._refusal("Disarming denied: not landed")
        self.armed = False
        if not self.firmware.guided_holds:  # ArduCopter stays in the mode that it is in
            self.mode = Mode.LOITER

    def take_off(self, height_m: float | None = None) -> None:
        """Rise; asked once more on the way, as after an answer that was lost, it goes on.

        Args:
            height_m: Above home; None for the parameter's.

        Raises:
            Refused: The motors stand, it flies already, or not so high.
        """
        if self.mode is Mode.TAKEOFF:
            return
        height_m = self._parameters["MIS_TAKEOFF_ALT"] if height_m is None else height_m
        if not self.armed:
            raise self._refusal("Takeoff denied: not armed")
        if not self.body.on_ground:
            raise self._refusal("Takeoff denied: already in the air")
        if self.firmware.guided_holds and (self.mode is not Mode.OFFBOARD or height_m <= self.body.position_m[2]):
            raise self._refusal("Takeoff denied: not in GUIDED, or not upwards")
        self._go(Mode.TAKEOFF, (*self.body.position_m[:2], height_m))

    def go_to(self, goal_m: Vector) -> None:
        """Fly to a point, seen from home, and stay there.

        Raises:
            Refused: It does not fly, or not there.
        """
        if self.body.on_ground:
            raise self._refusal("Reposition denied: not in the air")
        if self.firmware.guided_holds:
            self.change_mode(Mode.OFFBOARD)
            self.wish(goal_m, place=True)
        else:
            self._go(Mode.LOITER, goal_m)

    def wish(self, vector: Vector, *, place: bool) -> None:
        """Take a set-point for mode OFFBOARD: a place seen from home, or a velocity.

        ArduCopter takes none in another mode, none on the ground, and no place beyond its fence; one ends a take-off.
        """
        if self.firmware.guided_holds:
            if self.mode not in {Mode.OFFBOARD, Mode.TAKEOFF} or self.body.on_ground:
                return
            if place and not within_fence(vector, self.fence_m):
                return
            self.mode = Mode.OFFBOARD
        self._wish, self._wished_ns = (vector, place), self.body.now_ns

    def change_mode(self, mode: Mode) -> None:
        """Fly in another mode; the one that it is in goes on.

        Raises:
            Refused: There is nothing to fly: no mission, no set-points, or it stands.
        """
        if mode is self.mode:
            return
        if mode is Mode.TAKEOFF:
            self.take_off()
            return
        stands = not self.armed or self.body.on_ground
        if mode in {Mode.LAND, Mode.RTL} and stands and not self.firmware.lands_anywhere:
            raise self._refusal(f"{mode.name} denied: not in the air")
        if mode is Mode.OFFBOARD and not self.firmware.guided_holds and not self._wished_lately():
            raise self._refusal("OFFBOARD denied: no set-points")
        if mode is Mode.MISSION:
            if len(self.mission.items) <= self.firmware.first_item:
                raise self._refusal("MISSION denied: no mission")
            self.mission.begin()
        self._goal_m = self._rest_m()
        if mode is Mode.OFFBOARD and self.firmware.guided_holds:
            self._wish = (self._goal_m, True)
        self.mode = mode

    def load(self, items: tuple[Item, ...]) -> None:
        """Take a new mission; the one that it flies is given up, and it waits where it is."""
        if self.mode is Mode.MISSION:
            self.change_mode(Mode.LOITER)
        self.mission.load(items)

    def advance(self, now_ns: int) -> None:
        """Fly until this moment, as far as whole steps go."""
        while self.body.now_ns + STEP_NS <= now_ns:
            if not self.armed and self.body.on_ground:
                self.body.now_ns += (now_ns - self.body.now_ns) // STEP_NS * STEP_NS
                return
            self._watch()
            self.body.driven = self.armed
            self.body.step(self._wanted_m_s(), self.can)

    def _go(self, mode: Mode, goal_m: Vector) -> None:
        if not all(map(math.isfinite, goal_m)) or not within_fence(goal_m, self.fence_m):
            raise self._refusal(f"{mode.name} denied: beyond the fence")
        self.mode, self._goal_m = mode, goal_m

    def _refusal(self, why: str) -> Refused:
        """Return what is raised where it does not do something; ArduCopter's answer is all that it says."""
        return Refused("" if self.firmware.silent else why)

    def _watch(self) -> None:
        """Stop the motors of one that stands, and hold one that nobody leads, or that is led beyond the fence."""
        now_ns = self.body.now_ns
        if not self.body.on_ground:
            self._flew, self._stands_ns = True, now_ns
        landed = self._flew or self.mode in LANDING
        patience_s = self._parameters["COM_DISARM_LAND" if landed else "COM_DISARM_PRFLT"]
        if self.armed and now_ns - self._stands_ns > patience_s * 1e9:
            self.remarks.append("Disarmed by landing" if self._flew else "Disarmed by auto preflight disarming")
            self.disarm()
        if self.mode is Mode.OFFBOARD and self.firmware.guided_holds:
            self._watch_guided()
        elif self.mode is Mode.OFFBOARD:
            if not self._wished_lately():
                self.remarks.append("Offboard control lost: hold")
                self.change_mode(Mode.LOITER)
            elif self._leaves():
                self.remarks.append("Geofence: hold")
                self.change_mode(Mode.LOITER)

    def _watch_guided(self) -> None:
        """Hold one whose last velocity is long ago; bring home one that it leads over the fence (FENCE_ACTION)."""
        if self._wish[1]:
            return
        if self._leaves():
            self.remarks.append("Fence Breached")
            self.change_mode(Mode.RTL)
        elif not self._wished_lately():
            self._wish = (self._rest_m(), True)

    def _rest_m(self) -> Vector:
        """Return where it waits if it brakes now; who brakes again and again comes no farther than the fence."""
        return inside_fence(stop_m(self.body, self.can), self.fence_m)

    def _wished_lately(self) -> bool:
        since_ns = self._wished_ns
        return since_ns is not None and self.body.now_ns - since_ns <= self._parameters["COM_OF_LOSS_T"] * 1e9

    def _leaves(self) -> bool:
        """Whether it would come to stand beyond the fence, farther out than it is."""
        stands_m, here_m = stop_m(self.body, self.can), self.body.position_m
        far_m, high_m = self.fence_m
        out = math.hypot(*stands_m[:2])
        return out > max(far_m, math.hypot(*here_m[:2])) or stands_m[2] > max(high_m, here_m[2])

    def _wanted_m_s(self) -> Vector:
        """Return how it would like to fly now."""
        if self.mode is Mode.OFFBOARD:
            if self.body.on_ground and not self.firmware.lifts_off:
                return 0.0, 0.0, 0.0
            vector, place = self._wish
            return velocity_to(vector, self.body, self.can) if place else vector
        if self.mode is Mode.MISSION:
            return self._on_mission_m_s()
        if self.mode is Mode.RTL:
            return self._home_m_s()
        if self.mode in LANDING:
            return self._down_m_s()
        if self.mode is Mode.TAKEOFF and math.dist(self.body.position_m, self._goal_m) < NEAR_M:
            self.mode = Mode.OFFBOARD if self.firmware.guided_holds else Mode.LOITER
            self._wish = (self._goal_m, True)
        return velocity_to(self._goal_m, self.body, self.can)

    def _on_mission_m_s(self) -> Vector:
        order = self.mission.fly(self.body, self.home_m, self._parameters["NAV_ACC_RAD"])
        if isinstance(order, str):
            self.change_mode(Mode[order])
            return self._wanted_m_s()
        if order[2] < 0:
            self._goal_m = order
            return self._down_m_s()
        can = self.can
        speed_m_s = min(can.speed_m_s, self.mission.speed_m_s or can.speed_m_s)
        return velocity_to(order, self.body, replace(can, speed_m_s=speed_m_s))

    def _home_m_s(self) -> Vector:
        """Rise, fly home and land there (PX4's return mode)."""
        east, north, up = self.body.position_m
        if math.hypot(east, north) < self._parameters["NAV_ACC_RAD"]:
            self.mode, self._goal_m = Mode.HOMECOMING, (0.0, 0.0, 0.0)
            return self._down_m_s()
        height_m = min(max(self._goal_m[2], self._parameters["RTL_RETURN_ALT"]), self.fence_m[1])
        rises = up < height_m - NEAR_M and math.hypot(east, north) > self._parameters["NAV_ACC_RAD"]
        return velocity_to((*self._goal_m[:2], height_m) if rises else (0.0, 0.0, height_m), self.body, self.can)

    def _down_m_s(self) -> Vector:
        fast = self.body.position_m[2] > self._parameters["MPC_LAND_ALT2"]
        speed_m_s = self._parameters["MPC_Z_VEL_MAX_DN" if fast else "MPC_LAND_SPEED"]
        east, north, _ = velocity_to(self._goal_m, self.body, self.can)
        return east, north, -speed_m_s

"""The airframe of an emulated drone that a physics simulator moves; the autopilot only records its commands."""

from typing import Final

from typing_extensions import override

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.flight import STEP_NS, Airframe
from sim_backends.emulated.ros.flight_records import FlightCommand, FlightCommandRecord, FlightMotion, FlightRecord
from sim_backends.physics.body import Velocity
from sim_backends.physics.quadrotor import FlightPose, Quadrotor
from sim_backends.physics.robot_limits import QuadrotorLimits

_MAX_EXTRAPOLATION_NS: Final = 100_000_000
"""Longest extrapolation of a state of the physics simulator, which records one every 10 ms."""


class SimulatedAirframe(Airframe):
    """An `Airframe` that a physics simulator moves.

    The autopilot commands no thrust (`FlightCommand.powered` is False) while its motors are off, and on the ground
    until the drone must climb. The drone stays at the position at which the lab has placed it until the physics
    simulator records a state.

    Args:
        limits: Limits of the airframe.
        place_m: Position of its lowest point in the world, which is also home.
        facing_rad: Initial heading.
        now_ns: Time of the initial state.
        commands: Record of the autopilot's commands.
        flight_record: Record in which the physics simulator stores the flight.
        path_start_ns: Start time of the path with which the lab last placed it.
    """

    def __init__(
        self,
        limits: QuadrotorLimits,
        place_m: Vector,
        facing_rad: float,
        now_ns: int,
        *,
        commands: FlightCommandRecord,
        flight_record: FlightRecord,
        path_start_ns: int,
    ) -> None:
        super().__init__(limits, place_m, facing_rad, (), now_ns)
        self._commands = commands
        self._flight_record = flight_record
        self._path_start_ns = path_start_ns
        self._is_off = False

    @override
    def step(self, target_m_s: Vector, limits: QuadrotorLimits, yaw_rad: float | None = None) -> None:
        self.now_ns += STEP_NS
        self._sense()
        if not self.motors_on or (self.on_ground and target_m_s[2] <= 0):
            self._switch_off()
            return
        target = Quadrotor(limits, self.place_m).target(Velocity(target_m_s, yaw_rad))
        self._command(target, limits, powered=True)

    @override
    def rest(self, now_ns: int) -> None:
        super().rest(now_ns)
        self._sense()
        if not self._is_off:
            self._switch_off()

    def _switch_off(self) -> None:
        self._command(Velocity(), self._limits, powered=False)

    def _command(self, target: Velocity, limits: QuadrotorLimits, *, powered: bool) -> None:
        """Record a command for the physics simulator."""
        self._is_off = not powered
        self._commands.write(
            FlightCommand(
                self.now_ns,
                self._path_start_ns,
                powered,
                target.velocity_m_s,
                target.yaw_rad,
                limits.acceleration_m_s2,
                limits.climb_m_s2,
            )
        )

    def _sense(self) -> None:
        """Read the last state from the physics simulator, if there is one, and extrapolate it to the current time."""
        flight = self._flight_record.read()
        if flight is None or flight.path_start_ns != self._path_start_ns:
            return
        self.on_ground, self.turn_rad_s = flight.is_supported, flight.turn_rad_s
        self._pose = FlightPose(
            self._extrapolated_m(flight), flight.velocity_m_s, flight.roll_rad, flight.pitch_rad, flight.heading_rad
        )

    def _extrapolated_m(self, flight: FlightMotion) -> Vector:
        if flight.is_supported:
            return flight.place_m
        elapsed_s = min(max(self.now_ns - flight.time_ns, 0), _MAX_EXTRAPOLATION_NS) / 1e9
        (east_m, north_m, up_m), (east_m_s, north_m_s, up_m_s) = flight.place_m, flight.velocity_m_s
        return east_m + east_m_s * elapsed_s, north_m + north_m_s * elapsed_s, up_m + up_m_s * elapsed_s

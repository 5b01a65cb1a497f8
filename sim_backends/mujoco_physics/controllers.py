"""The controllers of robots in MuJoCo: wheel speeds of a robot on wheels, attitude and thrust of a quadrotor.

They run with the period `TICK_NS`, as on real robots; motors and attitude control run in MuJoCo at every step.
"""

import math
from dataclasses import dataclass
from typing import Final, Protocol

from sim_backends.mujoco_physics.chassis import Wheels
from sim_backends.mujoco_physics.mjcf import quaternion
from sim_backends.physics.body import Velocity
from sim_backends.physics.differential_drive import require_twist
from sim_backends.physics.quadrotor import FlightTarget, Quadrotor, VelocityController
from sim_backends.physics.robot_limits import DriveLimits, QuadrotorLimits

TICK_NS: Final = 10_000_000
"""Period of the controllers: PX4's velocity controller runs at 100 Hz."""
_UPRIGHT: Final = 0.1
"""Below this cosine of a quadrotor's tilt, thrust cannot keep its height, and the minimum thrust is used."""


@dataclass(frozen=True)
class Registers:
    """Flat arrays of the simulation that controllers read and write.

    Memory views access single items faster than NumPy.

    Attributes:
        ctrl: Set-points of the motors.
        qvel: Velocities of the joints; the first three of a free body are its velocity, metres per second.
        xmat: Rotation matrices of the bodies, row by row: 9 numbers each.
        xquat: Attitudes of the bodies: 4 numbers each.
        mocap_quat: Target attitudes: 4 numbers each.
        xfrc_applied: Forces and torques on the bodies: 6 numbers each.
    """

    ctrl: "memoryview[float]"
    qvel: "memoryview[float]"
    xmat: "memoryview[float]"
    xquat: "memoryview[float]"
    mocap_quat: "memoryview[float]"
    xfrc_applied: "memoryview[float]"


class Controller(Protocol):
    """The controller of a robot, which sets its motors so that the robot follows commands."""

    def command(self, command: object) -> None:
        """Set the command that is followed after the next tick.

        Raises:
            ConfigurationError: The command does not suit the robot.
        """
        ...

    def tick(self, registers: Registers, elapsed_s: float) -> bool:
        """Set the motors; return False if nothing changes before the next command.

        Args:
            registers: The simulation.
            elapsed_s: Time since the last tick, at most about `TICK_NS`.
        """
        ...


class WheelController:
    """Changes forward speed and yaw rate within their limits, like ROS's `diff_drive_controller`.

    Args:
        limits: Limits of the robot.
        wheels: Its wheels.
        motors: Indices of its motors, first the left ones.
    """

    def __init__(self, limits: DriveLimits, wheels: Wheels, motors: range) -> None:
        self._limits = limits
        self._wheels = wheels
        self._motors = motors
        self._target = 0.0, 0.0
        self._current = 0.0, 0.0

    def command(self, command: object) -> None:
        """Implement `Controller.command`."""
        twist, limits = require_twist(command), self._limits
        self._target = _clamp(twist.forward_m_s, limits.speed_m_s), _clamp(twist.turn_rad_s, limits.turn_rad_s)

    def tick(self, registers: Registers, elapsed_s: float) -> bool:
        """Implement `Controller.tick`."""
        if self._current == self._target:
            return False
        limits, wheels = self._limits, self._wheels
        speed_m_s = _step_towards(self._current[0], self._target[0], limits.acceleration_m_s2 * elapsed_s)
        turn_rad_s = _step_towards(self._current[1], self._target[1], limits.turn_acceleration_rad_s2 * elapsed_s)
        self._current = speed_m_s, turn_rad_s
        half_m_s = turn_rad_s * wheels.turning_track_m / 2
        count = len(self._motors) // 2
        for index, motor in enumerate(self._motors):
            registers.ctrl[motor] = (speed_m_s + (-half_m_s if index < count else half_m_s)) / wheels.radius_m
        return True


class FlightController:
    """Controls the velocity of a quadrotor with the control law of the built-in physics.

    Args:
        limits: Limits of the quadrotor.
        body: Index of its body.
        mocap: Index of the body without mass that has its target attitude.
        dof: Index of its first velocity component in `Registers.qvel`.
        motor: Index of the motor that exerts its thrust.
    """

    def __init__(self, limits: QuadrotorLimits, body: int, mocap: int, dof: int, motor: int) -> None:
        self._limits = limits
        self._velocity_law = VelocityController(limits)
        self._quadrotor = Quadrotor(limits, (0.0, 0.0, 0.0))
        self._indices = body, mocap, dof, motor
        self._target = Velocity()
        self._is_powered = True
        self._hold_yaw_rad: float | None = None
        # The attitude follows its target with a first-order lag: its rate is the difference divided by the lag. These
        # largest differences therefore limit the rate.
        self._max_lean_rad = limits.tilt_rate_rad_s * limits.lag_s
        self._max_turn_rad = limits.yaw_rate_rad_s * limits.lag_s

    def command(self, command: object) -> None:
        """Implement `Controller.command`."""
        if isinstance(command, FlightTarget):
            self._velocity_law = VelocityController(command.limits_within(self._limits))
            self._target, self._is_powered = command.velocity, command.powered
        else:
            self._velocity_law, self._is_powered = VelocityController(self._limits), True
            self._target = self._quadrotor.target(command)
        self._hold_yaw_rad = self._target.yaw_rad

    def tick(self, registers: Registers, elapsed_s: float) -> bool:  # noqa: ARG002 (see Controller)
        """Implement `Controller.tick`."""
        limits, (body, mocap, dof, motor) = self._limits, self._indices
        # Components east, north, up (e, n, u): x and z are axes of the body, v is its velocity, f is thrust per mass.
        x_e, _, z_e, x_n, _, z_n, _, _, z_u = registers.xmat[9 * body : 9 * body + 9]
        v_e, v_n, v_u = registers.qvel[dof : dof + 3]
        drag_n_s_m = limits.drag_n_s_m + limits.drag_n_s2_m2 * math.hypot(v_e, v_n, v_u)
        forces, first = registers.xfrc_applied, 6 * body
        forces[first], forces[first + 1], forces[first + 2] = (
            -drag_n_s_m * v_e,
            -drag_n_s_m * v_n,
            -drag_n_s_m * v_u,
        )
        targets, first = registers.mocap_quat, 4 * mocap
        if not self._is_powered:
            # If the target is the current attitude, the attitude control applies no torque except damping.
            registers.ctrl[motor] = 0.0
            for index in range(4):
                targets[first + index] = registers.xquat[4 * body + index]
            return True
        f_e, f_n, f_u = self._velocity_law.thrust_m_s2((v_e, v_n, v_u), self._target)
        yaw_rad = math.atan2(x_n, x_e)
        if self._hold_yaw_rad is None:
            self._hold_yaw_rad = yaw_rad
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        forward, left = f_e * cos + f_n * sin, f_n * cos - f_e * sin
        pitch_rad = math.atan2(z_e * cos + z_n * sin, z_u)
        roll_rad = math.asin(_clamp(z_e * sin - z_n * cos, 1.0))
        targets[first], targets[first + 1], targets[first + 2], targets[first + 3] = quaternion(
            yaw_rad + _clamp(math.remainder(self._hold_yaw_rad - yaw_rad, math.tau), self._max_turn_rad),
            pitch_rad + _clamp(math.atan2(forward, f_u) - pitch_rad, self._max_lean_rad),
            roll_rad + _clamp(-math.atan2(left, math.hypot(forward, f_u)) - roll_rad, self._max_lean_rad),
        )
        registers.ctrl[motor] = f_u / z_u * limits.mass_kg if z_u > _UPRIGHT else limits.thrust_n[0]
        return True


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


def _step_towards(now: float, target: float, limit: float) -> float:
    return target if abs(target - now) <= limit else now + math.copysign(limit, target - now)

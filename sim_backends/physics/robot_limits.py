"""Limits and sizes of the robots that the physics federate supports, and the robots by the name of their profile."""

import math
from dataclasses import dataclass
from typing import Final

from sim_backends.world.motion import GRAVITY_M_S2


@dataclass(frozen=True)
class DriveLimits:
    """Limits and size of a robot with a differential drive.

    Attributes:
        speed_m_s: Maximum speed in both directions.
        acceleration_m_s2: Maximum acceleration and deceleration.
        turn_rad_s: Maximum yaw rate.
        turn_acceleration_rad_s2: Maximum change of the yaw rate per second.
        radius_m: Radius of the upright cylinder that contains it.
        height_m: Height of that cylinder.
        friction: Coefficient of friction of its tires; on a slope with a larger rise over run they have no grip.
    """

    speed_m_s: float
    acceleration_m_s2: float
    turn_rad_s: float
    turn_acceleration_rad_s2: float
    radius_m: float
    height_m: float
    friction: float = 0.8


HUSKY_A200: Final = DriveLimits(1.0, 3.0, 2.0, 6.0, radius_m=0.6, height_m=0.39, friction=1.0)
"""Clearpath Husky A200: 1.0 m/s, 990 mm x 670 mm x 390 mm, climbs 45 degrees (data sheet); accelerations and rate of
turn from `husky_control/config/control.yaml` (github.com/husky/husky)."""

TURTLEBOT3_BURGER: Final = DriveLimits(0.22, 2.5, 2.84, 3.2, radius_m=0.113, height_m=0.192)
"""ROBOTIS TurtleBot3 Burger: 0.22 m/s, 2.84 rad/s, 138 mm x 178 mm x 192 mm (e-Manual, specifications); accelerations
from `turtlebot3_navigation2/param/burger.yaml` (github.com/ROBOTIS-GIT/turtlebot3); friction of rubber on dry ground
is an estimate.
"""


@dataclass(frozen=True)
class QuadrotorLimits:
    """Limits and size of a quadrotor.

    Attributes:
        mass_kg: Its mass.
        thrust_n: Minimum and maximum thrust of all rotors together.
        tilt_rad: Maximum roll, and maximum pitch.
        tilt_rate_rad_s: Maximum rate of roll and pitch.
        yaw_rate_rad_s: Maximum yaw rate.
        lag_s: Time constant of its attitude.
        drag_n_s_m: Linear drag, in newtons per m/s.
        drag_n_s2_m2: Quadratic drag, in newtons per m^2/s^2.
        speed_m_s: Maximum horizontal speed that its autopilot commands.
        climb_m_s: Maximum commanded speeds downwards and upwards.
        acceleration_m_s2: Maximum commanded horizontal acceleration.
        climb_m_s2: Maximum commanded accelerations downwards and upwards.
        gains_per_s: Acceleration per m/s of velocity error, horizontally and vertically.
        radius_m: Radius of the upright cylinder that contains it.
        height_m: Height of that cylinder.
    """

    mass_kg: float
    thrust_n: tuple[float, float]
    tilt_rad: float
    tilt_rate_rad_s: float
    yaw_rate_rad_s: float
    lag_s: float
    drag_n_s_m: float
    drag_n_s2_m2: float
    speed_m_s: float
    climb_m_s: tuple[float, float]
    acceleration_m_s2: float
    climb_m_s2: tuple[float, float]
    gains_per_s: tuple[float, float]
    radius_m: float
    height_m: float

    def drag_m_s2(self, speed_m_s: float) -> float:
        """Return the deceleration by drag at a speed."""
        return (self.drag_n_s_m + self.drag_n_s2_m2 * speed_m_s) * speed_m_s / self.mass_kg

    def drive_m_s2(self) -> float:
        """Return the maximum acceleration by thrust and gravity together.

        By the law of cosines it occurs at the minimum or the maximum thrust, with maximum roll and pitch.
        """
        upright = math.cos(self.tilt_rad) ** 2
        return max(
            math.sqrt(f * f - 2 * f * GRAVITY_M_S2 * upright + GRAVITY_M_S2**2)
            for f in (thrust_n / self.mass_kg for thrust_n in self.thrust_n)
        )

    def top_speed_m_s(self) -> float:
        """Return the speed at which drag equals the maximum acceleration by thrust and gravity."""
        a, b, c = self.drag_n_s2_m2, self.drag_n_s_m, self.drive_m_s2() * self.mass_kg
        return 2 * c / (b + math.sqrt(b * b + 4 * a * c))


IRIS: Final = QuadrotorLimits(
    mass_kg=1.5,
    thrust_n=(2.8, 28.27),
    tilt_rad=math.radians(45),
    tilt_rate_rad_s=math.radians(220),
    yaw_rate_rad_s=math.radians(200),
    lag_s=1 / 6.5,
    drag_n_s_m=0.556,
    drag_n_s2_m2=0.033,
    speed_m_s=12.0,
    climb_m_s=(1.5, 3.0),
    acceleration_m_s2=5.0,
    climb_m_s2=(3.0, 4.0),
    gains_per_s=(1.8, 4.0),
    radius_m=0.384,
    height_m=0.11,
)
"""3DR Iris as in PX4's simulation (github.com/PX4/PX4-SITL_gazebo-classic, `models/iris`): 1.5 kg; four rotors of
5.84e-6 N/(rad/s)^2 up to 1100 rad/s, so 28.27 N; rotor drag 1.75e-4 N/(rad/s)/(m/s) at the 794 rad/s of hovering;
0.47 m x 0.47 m x 0.11 m, rotors of 0.128 m around (0.13, 0.22) m. Limits and gains are PX4's defaults (parameter
reference: MPC_TILTMAX_AIR, MC_ROLLRATE_MAX, MC_YAWRATE_MAX, 1 / MC_ROLL_P, MPC_XY_VEL_MAX, MPC_Z_VEL_MAX_DN and UP,
MPC_ACC_HOR_MAX, MPC_ACC_DOWN_MAX and UP, MPC_XY_VEL_P_ACC, MPC_Z_VEL_P_ACC). The minimum thrust, a tenth of the
maximum, is an assumption. The drag of the body is the drag of a cube with a face of 0.47 m x 0.11 m: 1.225 kg/m^3 x
1.05 x 0.052 m^2 / 2.
"""

DUCKIEDRONE: Final = QuadrotorLimits(
    mass_kg=0.45,
    thrust_n=(0.9, 9.0),
    tilt_rad=math.radians(25),
    tilt_rate_rad_s=math.radians(120),
    yaw_rate_rad_s=math.radians(90),
    lag_s=0.2,
    drag_n_s_m=0.15,
    drag_n_s2_m2=0.01,
    speed_m_s=2.0,
    climb_m_s=(0.5, 0.5),
    acceleration_m_s2=2.0,
    climb_m_s2=(2.0, 2.0),
    gains_per_s=(1.2, 3.0),
    radius_m=0.2,
    height_m=0.12,
)
"""Duckietown Duckiedrone: a frame of the 250 mm class. No data sheet describes its flight; all values are
estimates from the mass of its parts and a thrust of twice its weight. Its speeds are low, because it flies indoors
and uses a camera for control.
"""

QUADROTORS: Final[dict[str, QuadrotorLimits]] = {"duckiedrone": DUCKIEDRONE, "iris": IRIS}
"""Flying robots."""
BODIES: Final[dict[str, DriveLimits | QuadrotorLimits]] = {
    "husky": HUSKY_A200,
    "turtlebot3_burger": TURTLEBOT3_BURGER,
    **QUADROTORS,
}
"""All robots; robots with a robot profile also have a radio."""


def quadrotor(profile: str) -> QuadrotorLimits:
    """Return the limits of a quadrotor with this profile; for an unknown profile, those of the Duckiedrone."""
    return QUADROTORS.get(profile, DUCKIEDRONE)

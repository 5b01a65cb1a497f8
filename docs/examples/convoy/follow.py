"""Follow the leader at a distance of 2 m and a headway of 1 s, by the odometry that arrives over the radio.

The control law and its period are those of the scenario `convoy` (`sim_backends/cosim/programs/follow.py`): an error
of the distance decays at 1/s, states are extrapolated to the present time, and the follower stops if no state has
arrived for 1 s. Both robots start with the same heading. The argument is the leader's initial distance in metres.
"""

import math
import sys

import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

PERIOD_S, TIMEOUT_S = 0.05, 1.0
STANDSTILL_M, HEADWAY_S, GAIN_PER_S, TURNING_PER_S = 2.0, 1.0, 1.0, 2.0
TOP_SPEED_M_S = 1.0


class Follower(Node):
    """A node that steers the follower; all positions are in the frame of its odometry."""

    def __init__(self, ahead_m: float) -> None:
        super().__init__("follow")
        self.ahead_m = ahead_m
        self.latest: dict[str, Odometry] = {}
        self.steered_s = self.now_s()
        self.velocities = self.create_publisher(Twist, "/follower/cmd_vel", 1)
        for robot in ("leader", "follower"):
            self.create_subscription(
                Odometry,
                f"/{robot}/odom",
                lambda odometry, robot=robot: self.latest.update({robot: odometry}),
                qos_profile_sensor_data,
            )
        self.create_timer(PERIOD_S, self.steer)

    def now_s(self) -> float:
        return self.get_clock().now().nanoseconds / 1e9

    def now(self, robot: str) -> tuple[float, float, float, float] | None:
        """Return position, heading and speed of a robot at the present time, or None without a valid state."""
        if (odometry := self.latest.get(robot)) is None:
            return None
        stamp = odometry.header.stamp
        age_s = self.now_s() - stamp.sec - stamp.nanosec / 1e9
        if age_s > TIMEOUT_S:
            return None
        pose, speed_m_s = odometry.pose.pose, odometry.twist.twist.linear.x
        heading_rad = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
        x_m = pose.position.x + speed_m_s * age_s * math.cos(heading_rad)
        y_m = pose.position.y + speed_m_s * age_s * math.sin(heading_rad)
        return x_m + (self.ahead_m if robot == "leader" else 0.0), y_m, heading_rad, speed_m_s

    def steer(self) -> None:
        """Publish the velocity that reduces the error of the distance; 0 without a valid state."""
        velocity = Twist()
        now_s = self.now_s()
        since_s, self.steered_s = min(now_s - self.steered_s, TIMEOUT_S), now_s  # a busy machine delays the timer
        leader, follower = self.now("leader"), self.now("follower")
        if leader is not None and follower is not None:
            x_m, y_m, heading_rad, speed_m_s = follower
            gap_m = math.hypot(leader[0] - x_m, leader[1] - y_m)
            bearing_rad = math.atan2(leader[1] - y_m, leader[0] - x_m)
            closing_m_s = leader[3] * math.cos(leader[2] - bearing_rad)
            error_m = gap_m - STANDSTILL_M - HEADWAY_S * speed_m_s
            acceleration_m_s2 = (closing_m_s - speed_m_s + GAIN_PER_S * error_m) / HEADWAY_S
            target_m_s = min(max(speed_m_s + acceleration_m_s2 * since_s, 0.0), TOP_SPEED_M_S)
            off_rad = math.remainder(bearing_rad - heading_rad, math.tau)
            velocity.linear.x = target_m_s * max(math.cos(off_rad), 0.0)
            velocity.angular.z = TURNING_PER_S * off_rad
            print(f"gap {gap_m:.3f} m, {speed_m_s:.3f} m/s", flush=True)
        self.velocities.publish(velocity)


rclpy.init()
rclpy.spin(Follower(float(sys.argv[1])))

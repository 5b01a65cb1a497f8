"""Drive the leader with the velocities of the scenario `convoy`.

Each argument is a leg, SECONDS:SPEED or SECONDS:SPEED:DEGREES_PER_SECOND. Without arguments the legs are those of the
scenario.
"""

import math
import sys
import time

import rclpy
from geometry_msgs.msg import Twist

PERIOD_S = 0.05
LEGS = ("5:0.4", "6:1", "5:0.3:4", "5:0.9:-4", "5:0.9", "4:0")


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("lead")
    velocities = node.create_publisher(Twist, "/leader/cmd_vel", 1)
    while not velocities.get_subscription_count():  # the base has not been discovered
        time.sleep(PERIOD_S)
    print("driving", flush=True)
    start_s = time.monotonic()
    end_s = 0.0
    for leg in sys.argv[1:] or LEGS:
        seconds, speed_m_s, turn_deg_s, *_ = [*map(float, leg.split(":")), 0.0]
        velocity = Twist()
        velocity.linear.x, velocity.angular.z = speed_m_s, math.radians(turn_deg_s)
        end_s += seconds
        while (left_s := start_s + end_s - time.monotonic()) > 0:
            velocities.publish(velocity)
            time.sleep(min(PERIOD_S, left_s))
    velocities.publish(Twist())


main()

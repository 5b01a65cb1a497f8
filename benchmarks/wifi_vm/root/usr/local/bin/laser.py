"""Publish the laser of a TurtleBot3 on /scan like its driver: 360 beams, five turns per second."""

import math

import rospy
from sensor_msgs.msg import LaserScan

rospy.init_node("turtlebot3_lds")
publisher = rospy.Publisher("/scan", LaserScan, queue_size=10)
scan = LaserScan(angle_max=2 * math.pi, angle_increment=math.pi / 180, range_min=0.12, range_max=3.5)
scan.header.frame_id = "base_scan"
scan.ranges = scan.intensities = [1.0 + beam / 360 for beam in range(360)]
turns = rospy.Rate(5)
while not rospy.is_shutdown():
    scan.header.stamp = rospy.Time.now()
    publisher.publish(scan)
    turns.sleep()

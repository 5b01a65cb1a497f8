"""An ordinary ROS 1 node, for Debian's Python: `ros1_end.py hear|say`.

`say` publishes numbered scans, starting with 1, until it is stopped; `hear` prints each received scan as JSON.
"""

import json
import signal
import sys
import threading

import rospy
from sensor_msgs.msg import LaserScan

verb = sys.argv[1]


def show(scan: LaserScan) -> None:
    stamp = [scan.header.stamp.secs, scan.header.stamp.nsecs]
    sys.stdout.write(json.dumps([stamp, scan.header.frame_id, list(scan.ranges)]) + "\n")
    sys.stdout.flush()


# rospy's signal handler closes topics immediately, and deadlocks if the signal arrives during `publish`.
rospy.init_node(verb, anonymous=True, disable_signals=True)
for signal_number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(
        signal_number, lambda *_: threading.Thread(target=rospy.signal_shutdown, args=("asked to",)).start()
    )
if verb == "hear":
    rospy.Subscriber("/scan", LaserScan, show, queue_size=100)
    rospy.spin()
else:
    publisher = rospy.Publisher("/scan", LaserScan, queue_size=100)
    rate, number = rospy.Rate(50), 1
    while not rospy.is_shutdown():
        scan = LaserScan(ranges=[number, 0.5])
        scan.header.stamp, scan.header.frame_id = rospy.Time(number, 5), "base"
        publisher.publish(scan)
        number += 1
        rate.sleep()

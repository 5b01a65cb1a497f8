"""A tf listener of ROS 1, run on a robot with its `python3` and setup file: `tf_listener.py FIXED TOPIC...`.

It receives `/tf` and `/tf_static` with Debian's `tf2_msgs`, and the first message of each topic as bytes: every
stamped message starts with its header. It prints JSON: the tree, the frame of each topic, and its path to the root.
"""

import json
import struct
import sys
import time

import rospy
from tf2_msgs.msg import TFMessage

LIMIT_S = 60.0

fixed_frame, *topics = sys.argv[1:]
parents: dict[str, str] = {}
latched: dict[str, bool] = {}
frames: dict[str, str] = {}


def store_transforms(message: TFMessage, topic: str) -> None:
    """Store the parent of each child frame, as tf2's BufferCore does."""
    for transform in message.transforms:
        parents[transform.child_frame_id] = transform.header.frame_id
    latched[topic] = message._connection_header.get("latching") == "1"


def store_header(message: rospy.AnyMsg, topic: str) -> None:
    """Store the frame of a message: std_msgs/Header is seq, secs, nsecs, and a string after its length."""
    (length,) = struct.unpack_from("<I", message._buff, 12)
    frames.setdefault(topic, message._buff[16 : 16 + length].decode())


def path(frame: str) -> list[str]:
    """Return the frames from a frame up to the root of its tree."""
    frames_up = [frame]
    while frames_up[-1] in parents:
        frames_up.append(parents[frames_up[-1]])
        if len(frames_up) > len(parents) + 1:
            raise ValueError(f"the transforms have a loop: {frames_up}")
    return frames_up


rospy.init_node("tf_listener", anonymous=True, disable_signals=True)
for topic in ("/tf", "/tf_static"):
    rospy.Subscriber(topic, TFMessage, store_transforms, topic, queue_size=100)
for topic in topics:
    rospy.Subscriber(topic, rospy.AnyMsg, store_header, topic, queue_size=1)
deadline_s = time.monotonic() + LIMIT_S
while time.monotonic() < deadline_s and (set(topics) - frames.keys() or {"/tf", "/tf_static"} - latched.keys()):
    time.sleep(0.05)
report = {
    "rospy": rospy.__file__,
    "parents": dict(parents),
    "frames": frames,
    "latched": latched,
    "paths": {frame: path(frame) for frame in sorted(set(frames.values()) - {""})},
    "reached": all(fixed_frame in path(frame) for frame in frames.values() if frame),
}
sys.stdout.write(json.dumps(report) + "\n")

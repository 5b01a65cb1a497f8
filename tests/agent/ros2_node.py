"""A node of a real ROS 2, by a Python that has rclpy: hears `/stream`, says it again as `/again`, tells what it saw.

Usage: python ros2_node.py COUNT TYPE; it ends after so many messages, and prints one object of JSON.
"""

import importlib
import json
import sys
import time

import rclpy
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message

LIMIT_S = 60.0


def main(count: int, kind: str) -> None:
    """Hear so many messages of a type, and print what they were."""
    package, _, name = kind.split("/")
    message_type = getattr(importlib.import_module(f"{package}.msg"), name)
    rclpy.init()
    node = rclpy.create_node("real")
    publisher = node.create_publisher(message_type, "/again", 10)
    heard = []

    def take(data: bytes) -> None:
        heard.append(data)
        publisher.publish(deserialize_message(data, message_type))

    node.create_subscription(message_type, "/stream", take, qos_profile_sensor_data, raw=True)
    deadline_s = time.monotonic() + LIMIT_S
    while len(heard) < count and time.monotonic() < deadline_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    (seen,) = node.get_publishers_info_by_topic("/stream")
    quality = seen.qos_profile
    told = {
        "heard": [data.hex() for data in heard],
        "again": [serialize_message(deserialize_message(data, message_type)).hex() for data in heard],
        "type": seen.topic_type,
        "hash": str(seen.topic_type_hash),
        "reliability": quality.reliability.name,
        "depth": quality.depth,
        "subscribers": [one.topic_type for one in node.get_subscriptions_info_by_topic("/again")],
    }
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()
    # What was said again last is still on the way.
    rclpy.spin_once(node, timeout_sec=1.0)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])

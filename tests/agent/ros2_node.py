"""A ROS 2 node that republishes messages of `/stream` on `/again`, and prints a report. It requires rclpy.

Usage: python ros2_node.py COUNT TYPE. It exits after COUNT messages, and prints one JSON object.
"""

import importlib
import json
import sys
import time

import rclpy
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message

LIMIT_S = 60.0


def main(count: int, type_name: str) -> None:
    """Receive `count` messages of a type, and print a report."""
    package, _, name = type_name.split("/")
    message_type = getattr(importlib.import_module(f"{package}.msg"), name)
    rclpy.init()
    node = rclpy.create_node("real")
    publisher = node.create_publisher(message_type, "/again", 10)
    messages = []

    def on_message(data: bytes) -> None:
        messages.append(data)
        publisher.publish(deserialize_message(data, message_type))

    node.create_subscription(message_type, "/stream", on_message, qos_profile_sensor_data, raw=True)
    deadline_s = time.monotonic() + LIMIT_S
    while len(messages) < count and time.monotonic() < deadline_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    (publisher_info,) = node.get_publishers_info_by_topic("/stream")
    quality = publisher_info.qos_profile
    report = {
        "heard": [data.hex() for data in messages],
        "again": [serialize_message(deserialize_message(data, message_type)).hex() for data in messages],
        "type": publisher_info.topic_type,
        "hash": str(publisher_info.topic_type_hash),
        "reliability": quality.reliability.name,
        "depth": quality.depth,
        "subscribers": [subscription.topic_type for subscription in node.get_subscriptions_info_by_topic("/again")],
    }
    sys.stdout.write(json.dumps(report) + "\n")
    sys.stdout.flush()
    # The last republished message may not have been sent yet.
    rclpy.spin_once(node, timeout_sec=1.0)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])

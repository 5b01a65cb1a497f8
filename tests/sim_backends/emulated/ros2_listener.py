"""A node of a real ROS 2, by a Python that has rclpy: hears topics, drives, and tells what it saw.

Usage: python ros2_listener.py COUNT TOPIC=TYPE...; it ends after so many messages of each, and prints JSON.
"""

import importlib
import json
import sys
import time
from typing import Any

import rclpy
from rclpy.qos import qos_profile_rosout_default, qos_profile_sensor_data

LIMIT_S = 60.0
DRIVEN_M = 0.1


def plain(value: Any) -> Any:  # noqa: ANN401 (of rclpy)
    """Return a message as JSON can have it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, int, float)):
        return value
    return [plain(one) for one in value.tolist()] if hasattr(value, "tolist") else [plain(one) for one in value]


def drive(node: Any, heard: list[Any]) -> None:  # noqa: ANN401 (of rclpy)
    """Tell the robot to drive ahead until its odometry says that it has."""
    twist = importlib.import_module("geometry_msgs.msg").Twist
    publisher, ahead = node.create_publisher(twist, "/cmd_vel", 10), twist()
    ahead.linear.x = 0.2
    deadline_s = time.monotonic() + LIMIT_S
    while heard[-1]["pose"]["pose"]["position"]["x"] < DRIVEN_M and time.monotonic() < deadline_s:
        publisher.publish(ahead)
        rclpy.spin_once(node, timeout_sec=0.05)


def main(count: int, kinds: dict[str, str]) -> None:
    """Hear so many messages of each topic, and print them."""
    rclpy.init()
    node = rclpy.create_node("listener")
    heard: dict[str, list[Any]] = {topic: [] for topic in kinds}
    for topic, kind in kinds.items():
        package, _, name = kind.split("/")
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)

        def take(message: object, into: list[Any] = heard[topic]) -> None:
            into.append(plain(message))

        node.create_subscription(message_type, topic, take, qos_profile_sensor_data)
    logged: list[Any] = []
    log_type = importlib.import_module("rcl_interfaces.msg").Log
    node.create_subscription(log_type, "/rosout", lambda line: logged.append(plain(line)), qos_profile_rosout_default)
    deadline_s = time.monotonic() + LIMIT_S

    def missing() -> bool:
        about = {line["msg"] for line in logged}
        lines = {f"{topic} has a subscriber" for topic in kinds}
        return min(map(len, heard.values())) < count or len(node.get_node_names()) < 2 or not lines <= about

    while missing() and time.monotonic() < deadline_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    drive(node, heard["/odom"])
    nodes = [name for name in node.get_node_names() if name != "listener"]
    types = dict(node.get_topic_names_and_types())
    told = {
        "logged": logged,
        "rosout": [
            (end.qos_profile.durability.name, end.qos_profile.lifespan.nanoseconds)
            for end in node.get_publishers_info_by_topic("/rosout")
        ],
        "heard": {topic: found[:count] for topic, found in heard.items()},
        "types": types,
        "hashes": {
            topic: [str(one.topic_type_hash) for one in node.get_publishers_info_by_topic(topic)]
            for topic in (*kinds, "/tf", "/tf_static")
        },
        "latched": [one.qos_profile.durability.name for one in node.get_publishers_info_by_topic("/tf_static")],
        "driven_m": heard["/odom"][-1]["pose"]["pose"]["position"]["x"],
        "nodes": nodes,
        "services_of_node": {
            name: [service for service, _ in node.get_service_names_and_types_by_node(name, "/")]
            for name in ("listener", *nodes)
        },
        "own_topics": [topic for topic, _ in node.get_publisher_names_and_types_by_node("listener", "/")],
        "of_node": {name: node.get_publisher_names_and_types_by_node(name, "/") for name in nodes},
    }
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), dict(word.split("=") for word in sys.argv[2:]))

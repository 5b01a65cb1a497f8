"""A node of a real ROS 2, run with a Python that has rclpy: receives topics, drives the robot, and prints a report.

Usage: python ros2_listener.py COUNT TOPIC=TYPE...; it stops after COUNT messages of each topic, and prints JSON.
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


def to_json_value(value: Any) -> Any:  # noqa: ANN401 (of rclpy)
    """Return a message as values that JSON can represent."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: to_json_value(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, int, float)):
        return value
    return (
        [to_json_value(item) for item in value.tolist()]
        if hasattr(value, "tolist")
        else [to_json_value(item) for item in value]
    )


def drive(node: Any, received_odometry: list[Any]) -> None:  # noqa: ANN401 (of rclpy)
    """Command the robot to drive ahead until its odometry has changed by `DRIVEN_M`."""
    twist = importlib.import_module("geometry_msgs.msg").Twist
    publisher, command = node.create_publisher(twist, "/cmd_vel", 10), twist()
    command.linear.x = 0.2
    deadline_s = time.monotonic() + LIMIT_S
    while received_odometry[-1]["pose"]["pose"]["position"]["x"] < DRIVEN_M and time.monotonic() < deadline_s:
        publisher.publish(command)
        rclpy.spin_once(node, timeout_sec=0.05)


def main(count: int, message_types: dict[str, str]) -> None:
    """Receive this number of messages of each topic, and print a report."""
    rclpy.init()
    node = rclpy.create_node("listener")
    received_messages: dict[str, list[Any]] = {topic: [] for topic in message_types}
    for topic, type_name in message_types.items():
        package, _, name = type_name.split("/")
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)

        def append(message: object, into: list[Any] = received_messages[topic]) -> None:
            into.append(to_json_value(message))

        node.create_subscription(message_type, topic, append, qos_profile_sensor_data)
    log_lines: list[Any] = []
    log_type = importlib.import_module("rcl_interfaces.msg").Log
    node.create_subscription(
        log_type, "/rosout", lambda line: log_lines.append(to_json_value(line)), qos_profile_rosout_default
    )
    deadline_s = time.monotonic() + LIMIT_S

    def is_incomplete() -> bool:
        texts = {line["msg"] for line in log_lines}
        lines = {f"{topic} has a subscriber" for topic in message_types}
        return (
            min(map(len, received_messages.values())) < count or len(node.get_node_names()) < 2 or not lines <= texts
        )

    while is_incomplete() and time.monotonic() < deadline_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    drive(node, received_messages["/odom"])
    nodes = [name for name in node.get_node_names() if name != "listener"]
    types = dict(node.get_topic_names_and_types())
    report = {
        "log": log_lines,
        "rosout": [
            (publisher.qos_profile.durability.name, publisher.qos_profile.lifespan.nanoseconds)
            for publisher in node.get_publishers_info_by_topic("/rosout")
        ],
        "messages": {topic: messages[:count] for topic, messages in received_messages.items()},
        "types": types,
        "hashes": {
            topic: [str(publisher.topic_type_hash) for publisher in node.get_publishers_info_by_topic(topic)]
            for topic in (*message_types, "/tf", "/tf_static")
        },
        "latched": [
            publisher.qos_profile.durability.name for publisher in node.get_publishers_info_by_topic("/tf_static")
        ],
        "driven_m": received_messages["/odom"][-1]["pose"]["pose"]["position"]["x"],
        "nodes": nodes,
        "services_of_node": {
            name: [service for service, _ in node.get_service_names_and_types_by_node(name, "/")]
            for name in ("listener", *nodes)
        },
        "topics_of_listener": [topic for topic, _ in node.get_publisher_names_and_types_by_node("listener", "/")],
        "topics_of_nodes": {name: node.get_publisher_names_and_types_by_node(name, "/") for name in nodes},
    }
    sys.stdout.write(json.dumps(report) + "\n")
    sys.stdout.flush()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), dict(word.split("=") for word in sys.argv[2:]))

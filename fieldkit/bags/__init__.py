"""Bags of ROS 1 and ROS 2: contents, check, repair and conversion."""

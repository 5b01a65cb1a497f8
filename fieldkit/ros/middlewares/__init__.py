"""Middlewares of ROS: discovery methods, ports, settings."""

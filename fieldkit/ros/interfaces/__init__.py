"""Interfaces of ROS: message types and their hashes, names, qualities of service."""

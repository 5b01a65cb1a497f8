"""Kinds of step of robots with ROS."""

"""Checks of the network between ROS programs on several robots: `fieldkit check --ros`."""

"""Bags of ROS 1 and ROS 2: what they hold, whether they are whole, repair of damaged ones, conversion."""

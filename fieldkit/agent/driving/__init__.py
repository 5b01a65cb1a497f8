"""Drive a robot along a path by its velocity topic and its odometry."""

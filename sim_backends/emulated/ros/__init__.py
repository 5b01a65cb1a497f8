"""ROS inside of an emulated robot: sensors that publish, commands that record."""

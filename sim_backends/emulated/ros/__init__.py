"""ROS inside an emulated robot: sensors that publish, commands that record."""

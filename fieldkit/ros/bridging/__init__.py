"""The bridge between ROS 1, DDS and Zenoh."""

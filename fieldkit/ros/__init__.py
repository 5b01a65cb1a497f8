"""ROS on the laptop: message types, names for DDS and Zenoh, qualities of service, bridges."""

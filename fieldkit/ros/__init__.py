"""ROS on the laptop's side: message types, names on the wire, qualities of service, bridges."""

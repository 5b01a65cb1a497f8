"""ROS 1 without its libraries: framing of TCPROS, a client of the master, a node."""

"""ROS 1 without its libraries: framing of TCPROS, calls between nodes and their master, a node."""

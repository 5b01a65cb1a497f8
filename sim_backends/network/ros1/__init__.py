"""ROS 1: a master at which nodes register, and TCPROS or UDPROS between them."""

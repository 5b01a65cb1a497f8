"""ROS 1: a master with whom nodes register, and TCPROS or UDPROS between them."""

# The ROS of Debian is in the default search paths.
export ROS_MASTER_URI=http://localhost:11311 ROS_PACKAGE_PATH=/usr/share

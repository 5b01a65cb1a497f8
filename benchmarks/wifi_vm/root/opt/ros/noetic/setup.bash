# Debian's ROS stands where programs are found anyhow.
export ROS_MASTER_URI=http://localhost:11311 ROS_PACKAGE_PATH=/usr/share

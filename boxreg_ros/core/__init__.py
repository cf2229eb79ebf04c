"""The method: numpy and torch, no I/O, no ROS, no clock."""

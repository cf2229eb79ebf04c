"""Files of recordings: MCAP, rosbag2 (sqlite3) and ROS 1 bags, whole or damaged."""

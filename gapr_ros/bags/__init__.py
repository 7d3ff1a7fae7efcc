"""rosbag2 bags: reading, writing, replay."""

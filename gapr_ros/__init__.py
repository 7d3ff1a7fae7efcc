"""GAPR for ROS 2: a node that registers point clouds, and tools for bags; thin, no mathematics of registration."""

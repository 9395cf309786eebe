"""Hand-eye calibration without a target, at the robot: a node, and its core without ROS."""

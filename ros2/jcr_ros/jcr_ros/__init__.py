"""Hand-eye calibration without a target, at the robot: the node and its core, which knows no ROS."""

"""Features, matches, and two-view geometries checked against the robot poses, as input of any mapper."""

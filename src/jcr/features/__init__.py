"""Features, matches and the two-view geometries that the robot confirms, in front of any mapper."""

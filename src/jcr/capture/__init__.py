"""Reading of captures: images and gripper poses in every format, checked."""

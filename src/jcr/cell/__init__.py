"""Every camera of a robot cell in one frame: fixed ones, several on a wrist, and those of another arm."""

"""Dense depth of images whose camera poses and intrinsics are known."""

"""Estimation of hand-eye transforms, cameras, points and robot errors from images and reported gripper poses."""

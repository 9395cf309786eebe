"""Captures taken at the robot and calibrated image by image."""

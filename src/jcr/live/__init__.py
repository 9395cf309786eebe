"""Captures that are taken at the robot and calibrated again after every image."""

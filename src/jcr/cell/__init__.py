"""Calibration of all cameras of a robot cell in one frame: fixed, on the same wrist, and on other arms."""
